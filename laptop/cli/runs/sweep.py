"""`swarm sweep`: see `--help`."""

import argparse
import contextlib
import json
import os
import sys
import time
from dataclasses import asdict
from typing import TextIO

from laptop.cli.runs import sweep_results
from sim.scenario import options as simulation
from sim.sweep.engines import ENGINES, Engine, dask, local
from sim.sweep.limit import search
from sim.sweep.measure import check
from sim.sweep.plan import OPTIONS, SweepPoint, jobs_of, points_of, seeds_of, setting_of, values_of
from swarm.errors import ConfigError
from swarm.process import log, service
from swarm.process.arguments import add_json, json_alone, number, picture, whole
from swarm.process.terminal import bar, steer

WITHIN = 0.01
"""Distance from its last value within which a result counts as settled, in its unit."""


def parser() -> argparse.ArgumentParser:
    """Return the argument parser of `swarm sweep`."""
    p = argparse.ArgumentParser(
        prog="swarm sweep",
        description="Run an app under virtual time over robots, topologies, parameters and seeds, on all cores.",
        epilog="All other options of swarm sim apply to every run: --iterations 200 --noise thesis ...",
    )
    p.add_argument("app", metavar="APP", help="a built-in app, or a file with one")
    p.add_argument("--robots", action="extend", type=values_of, metavar="N,N", help="numbers of robots")
    p.add_argument("--topology", action="extend", type=values_of, metavar="NAME,NAME", help="topologies")
    p.add_argument("--algorithm", action="extend", type=values_of, metavar="NAME,NAME", help="algorithms of the app")
    p.add_argument(
        "--set",
        dest="settings",
        action="append",
        type=setting_of,
        default=[],
        metavar="NAME=VALUE,VALUE",
        help="values of a parameter",
    )
    p.add_argument("--latency", action="extend", type=values_of, metavar="S,S", help="latencies of the links")
    p.add_argument(
        "--jitter", action="extend", type=values_of, metavar="S,S", help="standard deviations of the latency"
    )
    p.add_argument("--loss", action="extend", type=values_of, metavar="X,X", help="shares of lost radio packets")
    p.add_argument("--seeds", type=seeds_of, default=(1,), metavar="N|A-B", help="seeds 1 to N, or A to B (1)")
    p.add_argument(
        "--within",
        type=number(0.0),
        default=WITHIN,
        metavar="X",
        help=f"a result counts as settled this near to its last value, in its unit ({WITHIN:g})",
    )
    p.add_argument(
        "--limit",
        metavar="NAME=LOW,HIGH",
        help="find the largest value between LOW and HIGH with which all runs settle",
    )
    where = p.add_argument_group("where it is computed")
    where.add_argument(
        "--jobs",
        type=whole(1),
        default=os.cpu_count() or 1,
        metavar="N",
        help="number of processes (default: one for each core)",
    )
    where.add_argument(
        "--engine", choices=ENGINES, default="local", help="where runs are computed: local processes, or Dask"
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="address of a running Dask cluster, e.g. tcp://big:8786")
    out = p.add_argument_group("what comes out")
    add_json(out)
    out.add_argument("--plot", type=picture, metavar="FILE.png", help="draw the results")
    return p


def main() -> int:
    """Run the sweep. Return 0 where no run failed, or, with `--limit`, where each point has a value that settles."""
    log.setup("sweep")
    args, rest = parser().parse_known_args()
    with json_alone(args.json) as out:
        return _sweep(args, rest, out)


def _sweep(args: argparse.Namespace, rest: list[str], out: TextIO) -> int:
    points = points_of([(name, getattr(args, name)) for name in OPTIONS if getattr(args, name)], args.settings)
    if any(word.partition("=")[0] == "--record" for word in rest):
        raise ConfigError(
            "--record: a sweep has many runs, and they would all go to that folder; swarm sim records one"
        )
    for point in points:  # what is wrong with the command is said before anything is computed
        simulation.parse([args.app, *point.arguments(), *rest, "--virtual"])
    check(jobs_of(args.app, points, args.seeds[:1], rest, args.within))
    engine = dask(args.jobs, args.scheduler) if args.engine == "dask" else local(args.jobs)
    if args.limit is not None:
        return _limits(args, points, rest, engine, out)
    jobs = jobs_of(args.app, points, args.seeds, rest, args.within)
    began = time.monotonic()
    progress = _Progress(sys.stderr, len(jobs))
    with engine as run:
        found = run(jobs, progress.done)
    progress.close()
    if args.json:
        text = json.dumps({"app": args.app, "points": sweep_results.as_json(points, found)})
    else:
        computed = sum(each.computed_s for each in found)
        took = f"{len(jobs)} runs, {computed:.1f} s of computing in {time.monotonic() - began:.1f} s"
        text = f"{sweep_results.table(points, found)}\n\n{took}"
    out.write(f"{text}\n")
    if args.plot is not None:
        sweep_results.draw(args.app, points, found, args.plot)
        if not args.json:
            out.write(f"plot {args.plot}\n")
    return 1 if any(each.problem for each in found) else 0


def _limits(
    args: argparse.Namespace,
    points: list[SweepPoint],
    rest: list[str],
    engine: contextlib.AbstractContextManager[Engine],
    out: TextIO,
) -> int:
    name, values = setting_of(args.limit)
    try:
        low, high = map(float, values)
    except ValueError:
        raise ConfigError(f"--limit {args.limit}: expected NAME=LOW,HIGH") from None
    if not low < high:
        raise ConfigError(f"--limit {args.limit}: {low:g} is not below {high:g}, expected NAME=LOW,HIGH")
    lowest = [point.with_value(name, low) for point in points]
    check(jobs_of(args.app, lowest, args.seeds[:1], rest, args.within))
    progress = _Progress(sys.stderr, None)
    with engine as run:
        brackets = search(args.app, points, args.seeds, rest, args.within, name, (low, high), run, progress.done)
    progress.close()
    rows = [{**dict(point.choices), **asdict(each)} for point, each in zip(points, brackets, strict=True)]
    found = {"app": args.app, "limit": name, "points": rows}
    out.write(f"{json.dumps(found) if args.json else sweep_results.limits(points, name, brackets)}\n")
    return 1 if any(each.good is None for each in brackets) else 0


class _Progress:
    """The number of runs that are done: one line that is drawn again and again on a terminal; nothing elsewhere."""

    def __init__(self, stream: TextIO, total: int | None) -> None:
        self._stream, self._total = stream, total
        self._count = 0

    def done(self) -> None:
        """Count one more run."""
        self._count += 1
        if self._total is not None:
            bar(self._stream, self._count, self._total, " runs")
        elif self._stream.isatty():
            steer(self._stream, f"\r{self._count} runs")
            self._stream.flush()

    def close(self) -> None:
        if self._stream.isatty():
            steer(self._stream, "\r\x1b[K")
            self._stream.flush()


if __name__ == "__main__":
    service.run(main)
