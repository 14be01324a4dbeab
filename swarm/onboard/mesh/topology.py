"""`swarm mesh topology show|set`: which robots shall be linked, and changing that while the swarm runs.

Any one robot takes the wish; its mesh tells the others. Asked are the meshes whose buses can be reached: all of a
simulation, else this robot's own, which cannot say whether the others have followed already.
"""

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial

from swarm.bus.zenoh_bus import Bus
from swarm.core.graph import SHAPES
from swarm.errors import LocalError
from swarm.messages import Topology, TopologyRequest, TopologySet
from swarm.messages.keys import is_name
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE, Answers, new_ticket, opened, request
from swarm.onboard.command_line import add_verb
from swarm.onboard.mesh.tables import pairs
from swarm.process.arguments import add_json, number, show
from swarm.process.terminal import columns

HELP = "show or change the topology while the swarm runs"

AUTO = "auto"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `show` or `set WANTED...`, then options."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="show|set")
    verb = partial(add_verb, verbs, epilog=parser.epilog)
    look = verb("show", "show the topology in force on each robot; exit code 1 if a link is not up")
    change = verb("set", "change the topology of the whole swarm, and wait for its links")
    change.add_argument(
        "wanted",
        nargs="+",
        metavar="SHAPE|A-B",
        help=f"{', '.join(SHAPES)}, {AUTO} (robots find their neighbours), or all links: r0-r1 r1-r2 ... (a:b if a "
        "name has a dash)",
    )
    change.add_argument("--after", type=int, metavar="VERSION", help="change it only if this version is in force")
    change.add_argument(
        "--timeout", type=number(0), default=20.0, metavar="S", help="seconds to wait for the links (20)"
    )
    for each in (look, change):
        buses.add_arguments(each)
        add_json(each)


def run(args: argparse.Namespace) -> int:
    """Show or set the topology; code 1 where a robot is silent, has another version, or lacks a link. Raises
    `LocalError` for a refused wish."""
    wish = _wish(args.wanted) if args.verb == "set" else None
    with opened(buses.directories_of(args)) as found:
        answers = Answers(found, Topology, "mesh", "topology")
        if wish is None:
            answers.wait(PATIENCE, lambda: len(answers.newest) == len(found))
        else:
            version = _set(found, *wish, args.after)
            answers.wait(args.timeout, lambda: is_done(answers, version))
    if not answers.newest:
        raise LocalError(
            f"no mesh tells its topology: {', '.join(found)} ({PATIENCE:g} s); does it run? (swarm status)"
        )
    done = is_done(answers)
    told = {name: None if answer is None else asdict(answer) for name, answer in robots(answers).items()}
    show(args, {"done": done, "robots": told}, table(answers))
    return 0 if done else 1


def robots(answers: Answers[Topology]) -> dict[str, Topology | None]:
    """Return what each robot has told; None = it is silent."""
    return {name: answers.newest.get(name) for name in answers.buses}


def is_done(answers: Answers[Topology], version: int = 0) -> bool:
    """Return whether all tell one and the same topology, not an earlier one, and its links are up and no others."""
    known = robots(answers).values()
    values = {None if each is None else (each.version, each.step, each.issuer, each.edges) for each in known}
    return len(values) == 1 and all(
        each is not None and each.version >= version and each.wanted == each.up and not each.kept for each in known
    )


def table(answers: Answers[Topology]) -> list[str]:
    """Return the topology of each robot as lines for people."""
    rows: list[tuple[str, ...]] = [("robot", "version", "set on", "links up", "not up", "beyond it", "out of reach")]
    for name, each in robots(answers).items():
        if each is None:
            rows.append((name, "silent", "", "", "", "", ""))
            continue
        down = [peer for peer in each.wanted if peer not in each.up]
        missing = [f"{robot} ({why})" for robot, why in sorted(each.missing.items())]
        lists = (" ".join(each.up), " ".join(down), " ".join(each.kept), ", ".join(missing))
        rows.append((name, each.number, each.issuer or "-", *(text or "-" for text in lists)))
    newest = max(answers.newest.values(), key=lambda each: (each.version, each.step, each.issuer))
    end = [f"version {newest.number}{', automatic' if newest.auto else ''}: {pairs(newest.edges) or 'none yet'}"]
    if newest.links:
        end.append(f"carried by: {pairs(newest.links)}")
    return [*columns(rows), "", *end]


def _wish(words: list[str]) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Parse a shape or a list of links."""
    if len(words) == 1 and is_name(words[0].partition(":")[0]) and _pair(words[0]) is None:
        return words[0], ()
    edges = []
    for word in ",".join(words).split(","):
        pair = _pair(word)
        if pair is None:
            raise LocalError(f"{word[:40]!r} is no link: write r0-r1, or r0:r1 where a name has a dash")
        edges.append(pair)
    return "", tuple(edges)


def _pair(word: str) -> tuple[str, str] | None:
    """Return the two ends of a link; None where the word names none."""
    if word in SHAPES or word.startswith("random:"):
        return None
    a, mark, b = word.partition(":" if ":" in word else "-")
    return (a, b) if mark and is_name(a) and is_name(b) and (mark == ":" or "-" not in b) else None


def _set(found: Mapping[str, Bus], shape: str, edges: tuple[tuple[str, str], ...], after: int | None) -> int:
    """Ask the first robot whose bus is there. Return the version that is then in force. Raises `LocalError` where the
    wish is refused."""
    name = next(name for name, bus in found.items() if bus.connected)
    wish = TopologyRequest(new_ticket(), shape, edges, after)
    answer = request(found, {name: wish}, TopologySet, "mesh", "topology", PATIENCE).get(name)
    if answer is None:
        raise LocalError(f"the mesh of {name} does not answer within {PATIENCE:g} s")
    if answer.problem:
        raise LocalError(f"{name}: {answer.problem}")
    return answer.version
