"""`swarm config`: print a commented example of swarm.toml, or check one."""

import argparse
import sys
from pathlib import Path

from swarm.config.find import LOOKED_IN
from swarm.config.load import load
from swarm.config.types import DEFAULT_RELAY, STAR, TREE, Config
from swarm.core.graph import Graph
from swarm.onboard.command_line import add_verb
from swarm.process.arguments import add_json, show
from swarm.process.terminal import columns

HELP = "check a swarm.toml, or print a commented example"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--example`, or `check [FILE] [--json]`."""
    parser.add_argument("--example", action="store_true", help="print a commented file to start from")
    verbs = parser.add_subparsers(dest="verb", metavar="check [FILE]")
    check = add_verb(verbs, "check", "show what a swarm.toml contains, or its errors")
    check.add_argument("file", nargs="?", type=Path, metavar="FILE", help=f"configuration file (default: {LOOKED_IN})")
    add_json(check)
    parser.set_defaults(fail=parser.error)


def run(args: argparse.Namespace) -> int:
    """Print the example, or check a file. Raises `ConfigError` where the file is wrong."""
    if args.example == (args.verb is not None):
        args.fail("expected either --example or check [FILE]")
    if args.example:
        from swarm.config.example import EXAMPLE

        sys.stdout.write(EXAMPLE)
        return 0
    config = load(args.file, addressed=False)
    show(args, _summary(config), _text(config))
    return 0


def _unaddressed(config: Config) -> list[str]:
    """Return the robots without a Bluetooth address: so a file begins, and `swarm pair` completes it."""
    everywhere = config.auto or config.mesh.links in (STAR, TREE)
    return [
        each.name
        for each in config.robots
        if each.link is None and each.bluetooth is None and (everywhere or config.neighbours(each.name))
    ]


_AUTO = "links: robots find them themselves"


def _summary(config: Config) -> dict[str, object]:
    return {
        "file": str(config.path),
        "network": config.network,
        "robots": {
            robot.name: {
                "board": robot.board,
                "link": robot.link or (f"rfcomm:{robot.bluetooth}" if robot.bluetooth else None),
                "neighbours": config.neighbours(robot.name),
            }
            for robot in config.robots
        },
        "links": len(config.edges),
        "diameter": None if config.auto else Graph(config.names, config.edges).diameter(),
        "auto": config.auto,
        "relay": [rule.keys for rule in config.relay],
        "anchors": [anchor.address for anchor in config.anchors],
        "target": config.dwm.target,
        "apps": sorted(config.apps),
        "authenticated": not config.mesh.insecure,
        "unaddressed": _unaddressed(config),
    }


def _authentication(config: Config) -> str:
    if len(config.robots) == 1:
        return ""
    return ", not authenticated" if config.mesh.insecure else f", authenticated by the key in {config.mesh.key_file}"


def _text(config: Config) -> list[str]:
    graph = Graph(config.names, config.edges)
    rows = [("robot", "board", "reached at", "neighbours")]
    for robot in config.robots:
        link = robot.link or (f"rfcomm:{robot.bluetooth}" if robot.bluetooth else "-")
        rows.append((robot.name, robot.board, link, " ".join(graph.neighbours(robot.name)) or "-"))
    own_rules = len(config.relay) - len(DEFAULT_RELAY)
    anchors = ", ".join(f"{a.address} ({a.x:g}, {a.y:g})" for a in config.anchors)
    lacking = _unaddressed(config)
    return [
        f"{config.path}: fine; network {config.network}",
        *columns(rows),
        (_AUTO if config.auto else f"links: {len(graph.edges)}, diameter {graph.diameter()}") + _authentication(config),
        f"relay: {len(DEFAULT_RELAY)} rules of the platform, {own_rules} of the file",
        f"anchors: {anchors or 'none'}; target {config.dwm.target or 'none'}",
        f"apps with parameters: {', '.join(sorted(config.apps)) or 'none'}",
        *([f"no Bluetooth address yet: {' '.join(lacking)}; swarm pair writes them"] if lacking else []),
    ]
