"""`swarm measure i2c [ROBOT ...]`: how fast the I2C bus of each robot is, as in section 2.2.5 of the thesis.

Reads from and writes to the ATmega are timed one by one, with the pauses that it needs. The balancer owns the bus, so
it does that in the slack of its ticks; where it does not run on this robot, the bus is taken directly, for one size at
a time. In a simulation the time on the wire is counted by its bytes.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from services.balancer.core.devices.rates import RateMeter, longest
from services.balancer.device_drivers import Balboa
from services.balancer.i2c import RETRY_S, BusInUseError, I2CBus, KernelBus
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, SwarmError
from swarm.messages import I2CRates, MeasureI2C, Status
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import Answers, new_ticket, request
from swarm.process.arguments import add_json, show, sizes, whole
from swarm.process.paths import DEFAULT_RUNTIME

HELP = "measure the read and write rates of a robot's I2C bus"

SIZES = (1, 4, 8, 16, 28)
"""Bytes of data in a transfer."""
THESIS_KBIT_S = {"read": 21.0, "write": 53.0}
"""At 100 kHz (thesis 2.2.5); Pololu measured the same with transfers of 8 bytes."""

PATIENCE = 5.0
"""Seconds for an answer beyond the time that the balancer gives the transfers."""

Measure = Callable[[MeasureI2C], I2CRates]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`[ROBOT] [--sizes N,N] [--count N] [--json]`."""
    parser.add_argument("names", nargs="*", metavar="ROBOT", help="robots of the simulation (default: as --robots)")
    parser.add_argument(
        "--sizes", type=sizes(28), default=SIZES, metavar="N,N,...", help="sizes of 1 to 28 bytes (1,4,8,16,28)"
    )
    parser.add_argument("--count", type=whole(1, 1000), default=100, metavar="N", help="transfers of each kind (100)")
    add_json(parser)
    buses.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Measure through the balancer, or directly where there is none."""
    args.robots = args.robots or args.names
    found = {robot: _rates(args, robot, directory) for robot, directory in buses.directories_of(args).items()}
    data = {robot: [asdict(result) for result in results] for robot, results in found.items()}
    show(args, data, [line for robot, results in found.items() for line in table(robot, results)])
    return 0


def _rates(args: argparse.Namespace, robot: str, directory: Path) -> list[I2CRates]:
    """Yield the measured rates for each transfer size."""
    with Bus.of(directory) as bus:
        if bus.wait_connected(PATIENCE) and _answers(bus, robot):
            return _measured(args, robot, _through(bus, robot))
    if directory == DEFAULT_RUNTIME:
        try:
            return _measured(args, robot, directly)
        except BusInUseError as error:
            raise LocalError(
                f"the balancer of {robot} does not answer, and {error}. A running balancer measures by itself as soon "
                "as it answers: swarm services restart bus"
            ) from None
    raise LocalError(f"the balancer of {robot} does not answer ({directory})")


def _measured(args: argparse.Namespace, robot: str, measure: Measure) -> list[I2CRates]:
    results = []
    for size in args.sizes:
        result = measure(MeasureI2C(new_ticket(), size, args.count))
        if result.problem:
            raise LocalError(f"{robot}: {result.problem}")
        results.append(result)
    return results


def table(robot: str, results: list[I2CRates]) -> list[str]:
    """Return the rates as lines for people, beside those of the thesis."""
    lines = [f"{robot}: I2C with the ATmega, kbit/s of data", " bytes  transfers  failed     read    write"]
    for each in results:
        rates = "".join(f"{'-' if rate is None else f'{rate / 1e3:.1f}':>9}" for rate in (each.read, each.write))
        lines.append(f"{each.size:>6}{each.count:>11}{each.failed:>8}{rates}")
    thesis = "".join(f"{rate:>9.0f}" for rate in THESIS_KBIT_S.values())
    return [*lines, f"{'thesis, 8 bytes, 100 kHz':<25}{thesis}"]


def _answers(bus: Bus, robot: str) -> bool:
    """Return whether the robot's balancer is there."""
    asked = Answers({robot: bus}, Status, "balancer", "status")
    return asked.wait(2.0, lambda: bool(asked.newest))


def _through(bus: Bus, robot: str) -> Measure:
    """Measure by asking the balancer."""

    def measure(wish: MeasureI2C) -> I2CRates:
        seconds = PATIENCE + longest(wish.count)
        found = request(
            {robot: bus}, {robot: wish}, I2CRates, "balancer", "i2c", seconds, answered="i2c", every=seconds
        )
        if robot not in found:
            raise LocalError(f"the balancer of {robot} did not answer: are its devices there?")
        return found[robot]

    return measure


def measure(bus: I2CBus, driver: Balboa, request: MeasureI2C) -> I2CRates:
    """Run all transfers of a request, one after the other."""
    meter = RateMeter()
    meter.measure(request)
    while (transfer := meter.next(clock.now())) is not None:
        driver.settle()
        begun = clock.now() + bus.untimed()
        try:
            data = driver.transfer(transfer)
        except OSError as error:
            meter.fail(error, clock.now())
            bus.recover()
            continue
        driver.settle()
        meter.timed(clock.now() + bus.untimed() - begun)
        meter.take(data, clock.now())
    assert meter.news is not None
    return meter.news


def directly(request: MeasureI2C) -> I2CRates:
    """Measure on this robot's own bus. Afterwards the bus is left alone for longer than a balancer that waits for it
    takes to look again: so it has the bus after one request."""
    with opened() as (bus, driver):
        found = measure(bus, driver, request)
    time.sleep(2 * RETRY_S)
    return found


@contextmanager
def opened() -> Iterator[tuple[I2CBus, Balboa]]:
    """Open this robot's I2C bus and stop the motors. Raises `LocalError` where the ATmega does not answer, and
    `BusInUseError` while the balancer has the bus."""
    bus = KernelBus()
    try:
        driver = Balboa(bus, clock.now, bus.pause)
        try:
            driver.set_up()
        except (OSError, SwarmError) as error:
            raise LocalError(f"the ATmega does not answer: {error}") from None
        yield bus, driver
    finally:
        bus.close()
