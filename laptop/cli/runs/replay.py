"""`swarm replay RUN`: a recorded run once more, as its robots published it, on a bus that z_sub finds."""

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from swarm import clock
from swarm.bus.zenoh_bus import Bus, Router
from swarm.errors import LocalError
from swarm.process.arguments import number
from swarm.process.paths import bus_endpoint
from swarm.process.simulations import claim, default_run_dir
from swarm.recording.reader import RecordedSample
from swarm.recording.restore import published
from swarm.recording.run import Run

HELP = "publish a recorded run on a bus again, for z_sub and other viewers"

NAME = "replay"
"""The name of the replay's bus, which has the keys of all robots."""
OPENING_S = 5.0
"""Seconds that the bus may take to open."""
SETTLE_S = 0.3
"""Seconds before the first message, in which programs subscribe, and after the last one, in which messages arrive."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the run, the part of it to play, the speed, and the bus to play on."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or one recording (.mcap)")
    parser.add_argument(
        "keys", nargs="*", metavar="KEY", help="key expressions to publish, as for z_sub (default: all)"
    )
    parser.add_argument(
        "--speed", type=number(0, above=True), default=1.0, metavar="F", help="how many times faster than the run (1)"
    )
    parser.add_argument(
        "--start", type=number(), metavar="S", help="start at this second of the run (its first message)"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--json", action="store_true", help="print one JSON object a line, without waiting, in place of publishing"
    )
    where.add_argument("--on", type=Path, metavar="DIR", help="publish on the bus of this runtime directory")
    where.add_argument(
        "--run-dir", type=Path, metavar="DIR", help="runtime directory of the replay's own bus, as for swarm sim"
    )


def run(args: argparse.Namespace) -> int:
    """Play the run, and return 0 when all of it was played."""
    recorded = Run(args.run)
    for damage in recorded.damage:
        sys.stderr.write(f"note: {damage}\n")
    samples = (it for it in recorded.samples(*args.keys) if args.start is None or it.t >= args.start)
    if args.json:
        count = 0
        for sample in samples:
            count += 1
            line = {"t": round(sample.t, 9), "key": sample.topic, "message": sample.message}
            sys.stdout.write(json.dumps(line) + "\n")
        return _played(args, count)
    with _bus(args) as bus:
        if not bus.wait_connected(OPENING_S):
            place = args.on or "the run directory"
            raise LocalError(f"no bus answers within {OPENING_S:g} s: does one run in {place}?")
        time.sleep(SETTLE_S)
        count = _play(bus, samples, args.speed)
        time.sleep(SETTLE_S)
    print(f"{count} messages")
    return _played(args, count)


def _played(args: argparse.Namespace, count: int) -> int:
    """Return 0. Raises `LocalError` where there was nothing to play."""
    if not count:
        keys = f" under {' '.join(args.keys)}" if args.keys else ""
        start = "" if args.start is None else f" from {args.start:g} s on"
        raise LocalError(f"{args.run}: the recording has no message{keys}{start}")
    return 0


@contextlib.contextmanager
def _bus(args: argparse.Namespace) -> Iterator[Bus]:
    """Yield a bus that is there, or one of our own at the place where z_sub looks for simulations."""
    with contextlib.ExitStack() as stack:
        directory = args.on
        if directory is None:
            place = (args.run_dir or default_run_dir()).absolute()
            stack.enter_context(claim(place))
            directory = place / NAME
            directory.mkdir(exist_ok=True)
            stack.enter_context(Router(bus_endpoint(directory)))
            sys.stderr.write(f"playing on {bus_endpoint(directory)}: z_sub shows it\n")
        yield stack.enter_context(Bus.of(directory))


def _play(bus: Bus, samples: Iterator[RecordedSample], speed: float) -> int:
    """Publish each message when its time has come, and return how many there were."""
    began: float | None = None
    count = 0
    for sample in samples:
        count += 1
        if began is None:
            began = clock.now() - sample.t / speed
        time.sleep(max(0.0, began + sample.t / speed - clock.now()))
        bus.publish(sample.topic, published(sample.topic, sample.message))
    return count
