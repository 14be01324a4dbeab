"""`z_sub KEY...`: watch the bus of a robot, or of all simulated robots, decoded.

On a robot it watches the bus of /run/swarm (or SWARM_RUNTIME); while a simulation runs, the buses of all its robots.
From a laptop `--robots NAME` watches a real robot's, through ssh (laptop/cli/z_sub_ssh.py).
"""

import argparse
import contextlib
import os
import queue
import select
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.messages import AppParameters
from swarm.messages.codec import decoded
from swarm.messages.keys import EVERYTHING
from swarm.messages.keys import key as key_of
from swarm.onboard.buses import buses, samples
from swarm.onboard.command_line import complain, end_with
from swarm.process.arguments import CommandParser, add_robots, add_run_dir, number, whole
from swarm.process.paths import DEFAULT_RUNTIME, bus_endpoint, runtime_dir
from swarm.process.simulations import default_run_dir, is_live, robots

_ANSWER_S = 0.5
"""Seconds that an app has to say how its states lie in frames; without an answer they are shown in hexadecimal."""

_MOST_APPS = 256
"""Apps whose answers are kept."""

Source = Callable[[], Mapping[str, str] | None]
"""Name and endpoint of each bus to watch at this moment; None when there will be no more."""

_QUEUE = 20_000
"""Samples that may wait to be printed: a terminal that is slower than the bus must not take all memory."""

_LOOK_EVERY = 0.5
"""Seconds between two looks for new robots, lost buses and a reader that went away."""

_PATIENCE = 1.0
"""Seconds of silence about a bus that is not there yet: a session takes a moment to open."""


def main(argv: Sequence[str] | None = None, over_ssh: Callable[[argparse.Namespace], int] | None = None) -> NoReturn:
    """Run `z_sub`: our own errors are one line on stderr and exit code 2, never a traceback.

    `over_ssh` watches real robots from a laptop and returns the exit code; a robot has no such function.
    """

    def run() -> int:
        options = _parse(argv)
        if over_ssh is not None and _is_far(options):
            return over_ssh(options)
        _Watch(options).run()
        return 0

    end_with("z_sub", run, interrupted=0, unread=0)


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(
        prog="z_sub",
        usage="z_sub [options] [KEY ...]",
        description="Print the messages on the bus of a robot, or of all simulated robots.",
    )
    parser.add_argument("keys", nargs="*", metavar="KEY", help=f"key expressions, default {EVERYTHING}")
    parser.add_argument(
        "-k", "--key", action="append", default=[], metavar="KEY", help="a key expression, given as an option"
    )
    where = parser.add_argument_group("which bus")
    add_robots(where, "these robots: simulated, or real ones by ssh")
    add_run_dir(where)
    where.add_argument("-e", "--endpoint", help="the bus at unixsock-stream/PATH")
    where.add_argument("--config", type=Path, metavar="FILE", help="swarm.toml with the robots' hosts, for ssh")
    where.add_argument("--ssh-config", type=Path, metavar="FILE", help="in place of ~/.ssh/config, for ssh")
    output = parser.add_argument_group("output")
    output.add_argument("--rate", action="store_true", help="print rates by key, in place of samples")
    output.add_argument("--json", action="store_true", help="print one JSON object a line")
    output.add_argument("--count", type=whole(1), metavar="N", help="end after N samples")
    output.add_argument("--seconds", type=number(0, unit="s", above=True), metavar="S", help="end after S seconds")
    output.add_argument("--while-input", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.endpoint and (options.robots or options.run_dir):
        parser.error("--endpoint names one bus, --robots and --run-dir a simulation: use one of them")
    return options


def _is_far(options: argparse.Namespace) -> bool:
    """Return whether a real robot is meant that is not this one."""
    if not options.robots or options.run_dir:
        return False
    return bool(options.config or options.ssh_config) or not is_live(default_run_dir().absolute())


def _source(options: argparse.Namespace) -> Source:
    """Return the buses that the options mean. Raises `LocalError` where there is none."""
    if options.endpoint:
        return lambda: {"": options.endpoint}
    in_simulation = bool(options.robots or options.run_dir)
    if os.environ.get("SWARM_RUNTIME") and not in_simulation:
        return lambda: {"": bus_endpoint(runtime_dir())}
    directory = (options.run_dir or default_run_dir()).absolute()
    if is_live(directory):
        return lambda: _simulated(directory, options.robots)
    if in_simulation:
        raise LocalError(f"no simulation is running in {directory}")
    if DEFAULT_RUNTIME.is_dir():
        return lambda: {"": bus_endpoint(DEFAULT_RUNTIME)}
    raise LocalError(
        f"no simulation is running here (looked in {directory}), and this is no robot ({DEFAULT_RUNTIME} is not "
        "there); --run-dir, -e or SWARM_RUNTIME name another place"
    )


def _simulated(directory: Path, wanted: Sequence[str] | None) -> Mapping[str, str] | None:
    if not is_live(directory):
        return None
    # Nothing is found until the simulation has written its config.
    found = robots(directory)
    return {name: bus_endpoint(path) for name, path in buses.only_wanted(found, (found and wanted) or ()).items()}


class _Watch:
    """Buses in, lines out, until the count, the time, the simulation or the reader ends."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._keys: list[str] = [*options.keys, *options.key] or [EVERYTHING]
        self._json: bool = options.json
        self._rates = _Rates(json_lines=options.json) if options.rate else None
        self._left: int | None = options.count
        self._while_input: bool = options.while_input
        self._end = clock.now() + options.seconds if options.seconds else None
        self._source = _source(options)
        self._queue: queue.Queue[samples.BusSample] = queue.Queue(_QUEUE)
        self._lost = 0
        self._buses: dict[str, _Watched] = {}
        self._layouts: dict[tuple[str, str], dict[str, str]] = {}
        """The layouts of an app's states in its frames, by bus and app."""

    def run(self) -> None:
        with contextlib.ExitStack() as stack:
            look_at = clock.now()
            while self._left != 0 and (self._end is None or clock.now() < self._end):
                if clock.now() >= look_at:
                    if not self._look(stack):
                        break
                    look_at = clock.now() + _LOOK_EVERY
                self._take(look_at if self._end is None else min(look_at, self._end))
                if self._rates is not None:
                    self._rates.print_when_due()
        if self._rates is not None:
            self._rates.print_rest()
        if self._lost:
            complain("z_sub", f"{self._lost} samples came faster than they could be printed and are missing above")

    def _take(self, until: float) -> None:
        """Print the next sample, if one comes in time."""
        try:
            sample = self._queue.get(timeout=max(0.0, until - clock.now()))
        except queue.Empty:
            return
        if self._left is not None:
            self._left -= 1
        if self._rates is not None:
            self._rates.count(sample)
            return
        sample = self._with_layouts(sample)
        sys.stdout.write((samples.as_json if self._json else samples.as_text)(sample) + "\n")
        if self._queue.empty():
            sys.stdout.flush()

    def _with_layouts(self, sample: samples.BusSample) -> samples.BusSample:
        """Return the sample with its app's layouts of frames. The app is asked when its first frame comes."""
        app = samples.frame_app(sample.key)
        watched = self._buses.get(sample.robot)
        if not app or watched is None:
            return sample
        known = self._layouts.get((sample.robot, app))
        if known is None:
            if len(self._layouts) >= _MOST_APPS:
                self._layouts.clear()
            known = self._layouts[sample.robot, app] = watched.layouts(app)
        return sample._replace(layouts=known)

    def _look(self, stack: contextlib.ExitStack) -> bool:
        """Find new buses, tell what became of the others; False when there is nothing more to watch."""
        found = self._source()
        if found is None:
            complain("z_sub", "the simulation has ended")
            return False
        for name, endpoint in found.items():
            if name not in self._buses:
                bus = stack.enter_context(Bus(endpoint))
                bus.subscribe(self._keys, self._receiver(name))
                self._buses[name] = _Watched(bus, endpoint)
        for watched in self._buses.values():
            watched.tell_changes()
        return not (_nobody_reads() or (self._while_input and _input_has_ended()))

    def _receiver(self, robot: str) -> Callable[[str, bytes], None]:
        def receive(name: str, payload: bytes) -> None:
            try:
                self._queue.put_nowait(samples.BusSample(clock.wall(), robot, name, payload))
            except queue.Full:
                self._lost += 1

        return receive


class _Watched:
    """One bus, and what its user was told about it."""

    def __init__(self, bus: Bus, endpoint: str) -> None:
        self._bus = bus
        self._endpoint = endpoint
        self._opened = clock.now()
        self._told_connected = True

    def layouts(self, app: str) -> dict[str, str]:
        """Ask an app on this bus for the layouts of its frames and wait up to `_ANSWER_S`; empty without an answer."""
        told: queue.SimpleQueue[AppParameters] = queue.SimpleQueue()
        on_reply = decoded(AppParameters, told.put)
        self._bus.ask(key_of("*", f"app/{app}", "parameters"), on_reply, timeout_s=_ANSWER_S)
        with contextlib.suppress(queue.Empty):
            return told.get(timeout=_ANSWER_S).states
        return {}

    def tell_changes(self) -> None:
        """Tell when a bus is gone, and when it is back."""
        connected = self._bus.connected
        if connected != self._told_connected and clock.now() - self._opened >= _PATIENCE:
            self._told_connected = connected
            complain("z_sub", f"{self._endpoint} " + ("is there" if connected else "is not there, waiting for it"))


class _Rates:
    """Samples and bytes a second of each key."""

    def __init__(self, *, json_lines: bool) -> None:
        self._json = json_lines
        self._counts: dict[tuple[str, str], tuple[int, int]] = {}
        self._since = clock.now()

    def count(self, sample: samples.BusSample) -> None:
        number, size = self._counts.get((sample.robot, sample.key), (0, 0))
        self._counts[sample.robot, sample.key] = number + 1, size + len(sample.payload)

    def print_when_due(self) -> None:
        """Print once a second; a key that has gone quiet is shown once more, with 0, and then forgotten."""
        if clock.now() - self._since >= 1.0:
            self._print()
            self._counts = {name: (0, 0) for name, (number, _) in self._counts.items() if number}

    def print_rest(self) -> None:
        """Print what the last, incomplete second holds."""
        if any(number for number, _ in self._counts.values()):
            self._print()

    def _print(self) -> None:
        span, self._since = clock.now() - self._since, clock.now()
        for (robot, key), (count, size) in sorted(self._counts.items()):
            sys.stdout.write(self._line(robot, key, count / span, size / span) + "\n")
        sys.stdout.flush()

    def _line(self, robot: str, key: str, rate: float, volume: float) -> str:
        if self._json:
            return samples.rate_json(clock.wall(), robot, key, rate, volume)
        return samples.rate_text(clock.wall(), robot, key, rate, volume)


def _nobody_reads() -> bool:
    """Return whether the other end of a pipe behind stdout was closed: without samples no write would tell."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), 0)
        return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
    except (OSError, ValueError):
        return False


def _input_has_ended() -> bool:
    """Return whether whoever started us by ssh is gone: what comes in says nothing, its end does."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return False
    return not os.read(sys.stdin.fileno(), 4096)


if __name__ == "__main__":
    main()
