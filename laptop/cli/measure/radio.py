"""`swarm measure radio [RUN...]`: fit the slot radio to runs of consensus on robots.

Without recorded runs the robots make some (`experiments`). Each run is simulated with the robots and links of its own
swarm.toml. Runs in one piconet tell what a frame costs in the hosts, runs with bridges how long a bridge stays in each
piconet. What the recorded radio did besides is told too: links that were lost, roles that were not those wanted, round
trips.
"""

import argparse
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from laptop.cli.measure.experiments import APP, Laboratory
from laptop.fleet.ssh import everyone
from services.mesh.core.routing.physical_links import callers, links_of, physical, piconets
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.slots.fitting import Curve, FittedValue, fitted
from sim.virtual.radio.mesh import VirtualMesh
from sim.virtual.run import PLACE, VirtualRun
from swarm.config import load
from swarm.config.find import LOOKED_IN
from swarm.config.types import GRAPH
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.messages import LinkState
from swarm.process.arguments import add_json, show, whole
from swarm.process.terminal import columns
from swarm.recording.restore import published
from swarm.recording.run import Run
from swarm.recording.trajectory import WARM_UP, WINDOW, iteration_times, median

HELP = "fit the slot radio to the robots' radios, by runs of consensus"

STAYS = (0.04, 0.08, 0.15, 0.25, 0.4)
HOSTS = (0.0005, 0.0015, 0.004, 0.008, 0.016)
"""The values of the parameters `host` and `stay` that are simulated, s."""
VALUES = {"host": HOSTS, "stay": STAYS}
SEEDS = (11, 12)
MODELLED = 60
"""Iterations of each simulated run."""
REPORT = "report.txt"
UNLIKE = 1.3
"""Factor between model and recordings from which on the model does not describe a radio."""
FLAT = 1.15
"""Factor by which a run's pace must depend on a parameter to say anything of it."""


@frozen
class RadioBehaviour:
    """The behaviour of a radio in a run, recorded or simulated."""

    pace: float
    """Median of the seconds that an iteration takes."""
    rtt_median: float | None
    """Median round trip of the link whose median is the middle one of all links, s."""
    rtt_p99: float | None
    """99th percentile of the round trips of the link with the longest one, s."""
    lost: int
    """Links that were lost, whether or not they came back."""
    wrong: tuple[str, ...]
    """Ends of links with a role that is not the desired one."""


@frozen
class Recorded:
    """One recorded run."""

    path: Path
    robots: int
    links: int
    piconets: int
    """The number of piconets in which the busiest robot is."""
    radio: RadioBehaviour


def add_arguments(parser: argparse.ArgumentParser) -> None:
    text = "folder of a recorded run of consensus (default: the robots make four runs, which takes some ten minutes)"
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help=text)
    parser.add_argument(
        "--iterations", type=whole(20, 10_000), default=300, metavar="N", help="iterations of each new run (300)"
    )
    parser.add_argument(
        "--into", type=Path, default=Path("radio"), metavar="DIR", help="folder for new runs and the report (radio)"
    )
    everyone.add_config(parser, f"swarm.toml with the robots (default: {LOOKED_IN})")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    paths = args.runs or Laboratory(args, load(args.config)).go()
    runs = [_read(path) for path in paths]
    found: dict[str, FittedValue] = {}
    known: dict[str, float] = {}
    for name, values in VALUES.items():
        chosen = [each for each in runs if (each.piconets > 1) == (name == "stay")]
        curves = [curve for each in chosen if (curve := _curve(each, name, values, known))]
        if curves:
            found[name] = fitted(curves)
            known[name] = found[name].value
    if not found:
        raise LocalError("no run depends on the radio's parameters; record one with bridges, such as a loop of six")
    beside = [_simulated(each.path, known, SEEDS[0]) for each in runs]
    data = {
        "parameters": {name: asdict(each) for name, each in found.items()},
        "runs": [
            asdict(each) | {"path": str(each.path), "model": asdict(model)}
            for each, model in zip(runs, beside, strict=True)
        ],
    }
    lines = [*_table(runs, beside), "", *_verdict(found)]
    if not args.runs:
        (args.into / REPORT).write_text("\n".join([*lines, ""]), encoding="utf-8")
    show(args, data, lines)
    return 0


def _read(path: Path) -> Recorded:
    recorded = Run(path, APP)
    config = load(path / "swarm.toml", addressed=False)
    way = links_of(config, bluetooth=True)
    links = sorted(callers(config.names, config.edges)) if way == GRAPH else physical(config.names, config.edges, way)
    trajectories = recorded.trajectories()
    pace = median(iteration_times(trajectories))
    if pace is None:
        raise LocalError(f"{path}: the run is too short: expected {WARM_UP + WINDOW} iterations or more")
    end = max(each.newest for each in trajectories.values())
    told: dict[str, list[LinkState]] = {}
    for sample in recorded.samples("swarm/*/mesh/links"):
        if sample.t <= end:  # afterwards robots are switched off
            entries = published(sample.topic, sample.message)["links"]
            told[sample.topic.split("/")[1]] = [LinkState(**entry) for entry in entries]
    return Recorded(path, len(config.names), len(links), max(piconets(links).values()), _radio(pace, told))


def _radio(pace: float, told: Mapping[str, Sequence[LinkState]]) -> RadioBehaviour:
    """Return the radio's figures from each robot's last report of its links."""
    states = [(robot, link) for robot, links in told.items() for link in links]
    medians = [link.rtt_median for _, link in states if link.rtt_median is not None]
    longest = [link.rtt_p99 for _, link in states if link.rtt_p99 is not None]
    lost = {
        frozenset((robot, link.peer)): link.connection - (link.state in ("up", "suspect")) for robot, link in states
    }
    wrong = tuple(sorted(f"{robot} {link.peer}" for robot, link in states if link.role != link.wanted_role))
    return RadioBehaviour(
        pace, statistics.median(medians) if medians else None, max(longest, default=None), sum(lost.values()), wrong
    )


def _curve(each: Recorded, name: str, values: Sequence[float], known: Mapping[str, float]) -> Curve | None:
    """Return a run beside the model's runs; None where the parameter makes no difference to it."""
    model = {value: [_simulated(each.path, {**known, name: value}, seed).pace for seed in SEEDS] for value in values}
    paces = [statistics.fmean(of) for of in model.values()]
    return Curve(each.radio.pace, model) if max(paces) > FLAT * min(paces) else None


def _simulated(path: Path, parameters: Mapping[str, float], seed: int) -> RadioBehaviour:
    radio = "slots:" + ",".join(f"{name}={value!r}" for name, value in parameters.items())
    words = [APP, "--config", str(path / "swarm.toml"), "--virtual", "--radio", radio]
    options = parse([*words, "--seed", str(seed), "--iterations", str(MODELLED)])
    virtual = VirtualRun(options, build(options, PLACE))
    pace = median(iteration_times(virtual.go().trajectories))
    if pace is None:
        raise LocalError(f"{path}: its simulation over the slot radio does not iterate")
    meshes = {name: robot.mesh for name, robot in virtual.world.robots.items()}
    return _radio(pace, {name: mesh.links().links for name, mesh in meshes.items() if isinstance(mesh, VirtualMesh)})


def _table(runs: Sequence[Recorded], beside: Sequence[RadioBehaviour]) -> list[str]:
    measured = ("ms an iteration", "model", "rtt median", "model", "p99 ms", "model")
    rows: list[Sequence[str]] = [("run", "robots", "links", "piconets", *measured, "lost", "wrong roles")]
    for each, model in zip(runs, beside, strict=True):
        radio = each.radio
        rows.append(
            (
                each.path.name,
                str(each.robots),
                str(each.links),
                str(each.piconets),
                *_ms(radio.pace, model.pace),
                *_ms(radio.rtt_median, model.rtt_median),
                *_ms(radio.rtt_p99, model.rtt_p99),
                str(radio.lost),
                ", ".join(radio.wrong) or "none",
            )
        )
    return columns(rows)


def _ms(*times: float | None) -> Iterator[str]:
    return ("" if time is None else f"{1e3 * time:.0f}" for time in times)


def _verdict(found: dict[str, FittedValue]) -> list[str]:
    meant = {"host": "s of a frame in each host", "stay": "s that a bridge of two piconets stays in each"}
    lines = [
        f"{name} = {each.value:.2g} ({each.low:.2g} to {each.high:.2g}), {meant[name]}; "
        f"model and recordings differ by a factor of {each.factor:.2f}"
        for name, each in found.items()
    ]
    lines += [
        f"{name}: the model does not describe this radio"
        for name, each in found.items()
        if each.factor > UNLIKE or not VALUES[name][0] < each.value < VALUES[name][-1]
    ]
    lines += [f"{name}: no run tells it" for name in meant if name not in found]
    values = ",".join(f"{name}={each.value:.2g}" for name, each in found.items())
    return [*lines, f"simulate this radio with: --radio slots:{values}"]
