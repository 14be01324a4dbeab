"""The facts about a robot's system for `swarm doctor`, beyond those of provisioning: read only, as root."""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
from collections.abc import Callable
from typing import Any

from swarm.onboard.bootstrap import facts, pairing
from swarm.onboard.bootstrap.commands import below, line, run, text, unit

I2C_SLAVE = 0x0703
"""ioctl of linux/i2c-dev.h that sets the address for the next reads and writes."""

_ASKED = "LoadState,ActiveState,SubState,NRestarts,Result,UnitFileState"
UNITS = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm")


def main(request: dict[str, Any], tell: Callable[[object], None]) -> dict[str, Any]:
    """Return the facts, and: memory, temperature, throttled, services, devices, key, config, robot, pairing. The
    request also names the file of the key."""
    root = request.get("root", "/")
    found = facts.main(request, tell)
    services = {name: unit(f"{name}.service", _ASKED) for name in UNITS}
    config = text(below(root, "/etc/swarm/swarm.toml"))
    settings = (text(below(root, "/etc/swarm/robot.env")) or "").splitlines()
    names = [row.partition("=")[2] for row in settings if row.startswith("SWARM_ROBOT=")]
    return {
        **found,
        "memory": _memory(root),
        "temperature": int(line(below(root, "/sys/class/thermal/thermal_zone0/temp")) or 0) / 1000 or None,
        "throttled": _throttled(root),
        "services": services,
        "devices": _devices(root),
        "key": facts.key_facts(below(root, request["key"])) if request.get("key") else None,
        "config": None if config is None else hashlib.sha256(config.encode()).hexdigest(),
        "robot": names[-1] if names else None,
        "pairing": pairing.main({"do": "look"}, tell) if request.get("bluetooth") else None,
    }


def _memory(root: str) -> int | None:
    """Return the bytes of memory that are available to programs."""
    for row in (text(below(root, "/proc/meminfo")) or "").splitlines():
        if row.startswith("MemAvailable:"):
            return int(row.split()[1]) * 1024
    return None


def _throttled(root: str) -> int | None:
    """Return the flags of Raspberry Pi's firmware (vcgencmd get_throttled), None where it tells none."""
    said = line(below(root, "/sys/devices/platform/soc/soc:firmware/get_throttled"))
    if not said:
        code, out, _ = run("vcgencmd", "get_throttled")
        said = out.strip().partition("=")[2] if code == 0 else ""
    try:
        return int(said, 16)
    except ValueError:
        return None


def _devices(root: str) -> dict[str, Any] | None:
    """Read from the I2C bus: WHO_AM_I of the IMU, layout and revision of the ATmega's firmware, the display. None where
    a process has the bus: the balancer tells by itself what does not answer."""
    try:
        bus = os.open(below(root, "/dev/i2c-1"), os.O_RDWR)
    except OSError as error:
        return {"problem": os.strerror(error.errno or 0)}
    try:
        fcntl.flock(bus, fcntl.LOCK_EX | fcntl.LOCK_NB)
        atmega = _read(bus, 0x14, 0, 18)
        imu = _read(bus, 0x6B, 0x0F, 1)
        return {
            "problem": "",
            "imu": imu[0] if imu else None,
            "atmega": [atmega[0], atmega[17]] if atmega else None,
            "display": _read(bus, 0x3C, 0, 1) is not None,
        }
    except BlockingIOError:
        return None
    finally:
        os.close(bus)


def _read(bus: int, address: int, index: int, count: int) -> bytes | None:
    """Return bytes from an index on; None where no device answers."""
    try:
        fcntl.ioctl(bus, I2C_SLAVE, address)
        os.write(bus, bytes([index]))
        time.sleep(0.001)  # the ATmega's STOP has to be handled before the next START
        return os.read(bus, count)
    except OSError:
        return None
