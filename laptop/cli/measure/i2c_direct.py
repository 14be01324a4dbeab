"""`python -m laptop.cli.measure.i2c_direct ROBOT`: I2C rates on a robot whose balancer does not run.

`swarm measure i2c` starts it where that is so. The motors are stopped first; nothing else is changed.
"""

import argparse

from laptop.cli.measure import i2c
from services.balancer.core.rates import RateMeter
from services.balancer.drivers import Balboa
from services.balancer.i2c import I2CBus, KernelBus
from swarm import clock
from swarm.errors import LocalError, SwarmError
from swarm.messages import I2CRates, MeasureI2C
from swarm.process.edges import run


def measure(bus: I2CBus, driver: Balboa, request: MeasureI2C) -> I2CRates:
    """All transfers of a request, one after the other."""
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


def main() -> None:
    """Measure and print, as `swarm measure i2c` does."""
    parser = argparse.ArgumentParser(prog="swarm measure i2c", description=i2c.HELP)
    i2c.add_arguments(parser)
    args = parser.parse_args()
    bus = KernelBus()
    try:
        driver = Balboa(bus, clock.now, bus.pause)
        try:
            driver.set_up()
        except (OSError, SwarmError) as error:
            raise LocalError(f"the ATmega does not answer: {error}") from None
        i2c.measured(args, args.name or "this robot", lambda request: measure(bus, driver, request))
    finally:
        bus.close()


if __name__ == "__main__":
    run(main)
