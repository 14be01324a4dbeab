"""The ATmega without the loop: for tools that have stopped the balancer. One at a time owns the I2C bus."""

from services.balancer.core import balboa
from services.balancer.i2c import I2CBus


def versions(bus: I2CBus) -> tuple[int, int] | None:
    """Layout and revision of its firmware; None where nobody answers."""
    try:
        bus.pause(balboa.PAUSE_S)
        bus.write(balboa.ADDRESS, bytes((balboa.VERSION,)))
        bus.pause(balboa.PAUSE_S)
        data = bus.read(balboa.ADDRESS, balboa.REVISION + 1)
    except OSError:
        return None
    return data[balboa.VERSION], data[balboa.REVISION]


def enter_bootloader(bus: I2CBus) -> bool:
    """Motors off, and into the bootloader; False where it does not take the command: nobody answers, or no firmware
    of ours."""
    try:
        bus.pause(balboa.PAUSE_S)
        bus.write(balboa.ADDRESS, bytes((balboa.MOTORS,)) + balboa.encode_motors(0.0, 0.0))
        bus.pause(balboa.PAUSE_S)
        bus.write(balboa.ADDRESS, bytes((balboa.COMMAND,)) + balboa.BOOTLOADER_COMMAND.to_bytes(2, "little"))
    except OSError:
        return False
    return True
