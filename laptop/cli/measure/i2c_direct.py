"""I2C rates on a robot whose balancer does not run. The motors are stopped first; nothing else is changed."""

from collections.abc import Iterator
from contextlib import contextmanager

from services.balancer.core.rates import RateMeter
from services.balancer.drivers import Balboa
from services.balancer.i2c import I2CBus, KernelBus
from swarm import clock
from swarm.errors import LocalError, SwarmError
from swarm.messages import I2CRates, MeasureI2C


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


@contextmanager
def opened() -> Iterator[tuple[I2CBus, Balboa]]:
    """Open this robot's I2C bus and stop the motors. Raises `LocalError` where the ATmega does not answer."""
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
