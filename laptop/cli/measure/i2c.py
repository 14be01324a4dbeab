"""`swarm measure i2c [ROBOT]`: how fast a robot's I2C bus is, as in section 2.2.5 of the thesis.

Reads from and writes to the ATmega are timed one by one, with the pauses that it needs. The balancer owns the bus, so
it does that in the slack of its ticks; where it does not run on this robot, the bus is taken directly. In a simulation
the time on the wire is counted by its bytes.
"""

import argparse
import json
import os
import queue
from collections.abc import Callable
from dataclasses import asdict

from laptop.cli.measure import i2c_direct
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import I2CRates, MeasureI2C, read
from swarm.messages.keys import key
from swarm.onboard import buses
from swarm.process.paths import DEFAULT_RUNTIME
from swarm.process.terminal import write_lines

HELP = "read and write rates of a robot's I2C bus"

SIZES = (1, 4, 8, 16, 28)
"""Bytes of data in a transfer."""
THESIS_KBIT_S = {"read": 21.0, "write": 53.0}
"""At 100 kHz (thesis 2.2.5); Pololu measured the same with transfers of 8 bytes."""

PATIENCE = 5.0
"""s for an answer beyond the ticks that the transfers take."""
_TICK = 0.01

Measure = Callable[[MeasureI2C], I2CRates]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`[ROBOT] [--sizes N,N] [--count N] [--json]`."""
    parser.add_argument("name", nargs="?", metavar="ROBOT", help="of a simulation; else the own robot")
    parser.add_argument("--sizes", type=_sizes, default=SIZES, metavar="N,N,...", help="bytes, 1 to 28 (1,4,8,16,28)")
    parser.add_argument("--count", type=_count, default=100, metavar="N", help="transfers of each size and kind (100)")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    buses.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Measure through the balancer, or directly where there is none."""
    args.robot = args.robot or args.name
    directories = buses.find(args)
    if len(directories) != 1:
        raise LocalError(f"of which robot? there are {', '.join(directories)}")
    ((robot, directory),) = directories.items()
    with Bus.of(directory) as bus:
        if bus.wait_connected(PATIENCE) and _answers(bus, robot):
            return _measured(args, robot, _through(bus, robot))
    if directory == DEFAULT_RUNTIME:
        with i2c_direct.opened() as (bus, driver):
            return _measured(args, robot, lambda request: i2c_direct.measure(bus, driver, request))
    raise LocalError(f"the balancer of {robot} does not answer ({directory})")


def _measured(args: argparse.Namespace, robot: str, measure: Measure) -> int:
    """Measure each size and print."""
    results = []
    for size in args.sizes:
        result = measure(MeasureI2C(f"{os.getpid()}-{size}", size, args.count))
        if result.problem:
            raise LocalError(f"{robot}: {result.problem}")
        results.append(result)
    if args.json:
        print(json.dumps({"robot": robot, "sizes": [asdict(result) for result in results]}))
    else:
        write_lines(table(robot, results))
    return 0


def table(robot: str, results: list[I2CRates]) -> list[str]:
    """For people; beside it what the thesis had."""
    lines = [f"{robot}: I2C with the ATmega, kbit/s of data", " bytes  transfers  failed     read    write"]
    for each in results:
        rates = "".join(f"{'-' if rate is None else f'{rate / 1e3:.1f}':>9}" for rate in (each.read, each.write))
        lines.append(f"{each.size:>6}{each.count:>11}{each.failed:>8}{rates}")
    thesis = "".join(f"{rate:>9.0f}" for rate in THESIS_KBIT_S.values())
    return [*lines, f"{'thesis, 8 bytes, 100 kHz':<25}{thesis}"]


def _answers(bus: Bus, robot: str) -> bool:
    replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    bus.ask(key(robot, "balancer", "status"), lambda _, payload: replies.put(payload))
    try:
        replies.get(timeout=2.0)
    except queue.Empty:
        return False
    return True


def _through(bus: Bus, robot: str) -> Measure:
    answers: queue.SimpleQueue[I2CRates] = queue.SimpleQueue()

    def take(text: str, payload: bytes) -> None:
        try:
            message = read(text, payload)
        except PayloadError:
            return
        if isinstance(message, I2CRates):
            answers.put(message)

    bus.subscribe(key(robot, "balancer", "i2c"), take)

    def measure(request: MeasureI2C) -> I2CRates:
        bus.publish(key(robot, "balancer", "set", "i2c"), request)
        # Reads and writes in turn, one in each tick that has room for it: others have their transfers to do as well.
        end = clock.now() + PATIENCE + 2 * request.count * 4 * _TICK
        while (left := end - clock.now()) > 0.0:
            try:
                answer = answers.get(timeout=left)
            except queue.Empty:
                break
            if answer.ticket == request.ticket:
                return answer
        raise LocalError(f"the balancer of {robot} did not answer: are its devices there?")

    return measure


def _sizes(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if all(part.isdecimal() and 1 <= int(part) <= 28 for part in parts):
        return tuple(dict.fromkeys(map(int, parts)))
    raise argparse.ArgumentTypeError(f"{text!r}: expected sizes from 1 to 28 bytes, like 1,8,28")


def _count(text: str) -> int:
    if text.isdecimal() and 1 <= int(text) <= 1000:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r}: expected a number from 1 to 1000")
