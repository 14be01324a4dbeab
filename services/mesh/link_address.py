"""Link addresses: where a link leads, as one line of text `type:parameters`.

sim:PATH         a Unix socket with a simulated radio behind it
slots:PATH       a Unix socket at which the process calls that simulates a Bluetooth radio for all robots
tcp:HOST:PORT    Wi-Fi or Ethernet; HOST may be [IPv6]
rfcomm:ADDRESS   Bluetooth Classic; ADDRESS is that of the robot's adapter, XX:XX:XX:XX:XX:XX
"""

import re
from pathlib import Path

from swarm.config.types import RobotConfig
from swarm.errors import ConfigError
from swarm.frozen import frozen
from swarm.process.paths import socket_path


@frozen
class Sim:
    """A simulated link."""

    path: Path


@frozen
class Slots:
    """A robot at a simulated Bluetooth radio, which calls it here."""

    path: Path


@frozen
class Tcp:
    """A TCP address."""

    host: str
    port: int


@frozen
class Rfcomm:
    """A Bluetooth address."""

    address: str


LinkAddress = Sim | Slots | Tcp | Rfcomm

_ADDRESS = re.compile(r"([0-9A-Fa-f]{2}:){5}[0-9A-Fa-f]{2}")


def parse(text: str) -> LinkAddress:
    """Read a link address; raises `ConfigError` with what was expected."""
    kind, _, rest = text.partition(":")
    if kind in ("sim", "slots") and rest:
        path = socket_path(Path(rest).parent, Path(rest).name)
        return Sim(path) if kind == "sim" else Slots(path)
    if kind == "tcp":
        return parse_address(rest, text)
    if kind == "rfcomm" and _ADDRESS.fullmatch(rest):
        return Rfcomm(rest.upper())
    raise ConfigError(f"link {text!r}: expected sim:PATH, tcp:HOST:PORT or rfcomm:ADDRESS (XX:XX:XX:XX:XX:XX)")


def parse_address(address: str, whole: str) -> Tcp:
    """Read HOST:PORT; `whole` is what the error shows."""
    host, _, port = address.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    if not host or not port.isascii() or not port.isdigit() or len(port) > 5 or not 1 <= int(port) <= 65535:
        raise ConfigError(f"{whole!r}: expected HOST:PORT with a port from 1 to 65535")
    try:
        host.encode("idna")
    except UnicodeError as error:
        raise ConfigError(f"{whole!r}: {host!r} is no name of a host: {error}") from None
    return Tcp(host, int(port))


def of_robot(robot: RobotConfig) -> LinkAddress:
    """Return the address of a robot for the others. Raises `ConfigError` with the robot's name."""
    if robot.link is None and robot.bluetooth is None:
        raise ConfigError(f"robot {robot.name}: it has neither a link nor a Bluetooth address to be reached at")
    try:
        return parse(robot.link or f"rfcomm:{robot.bluetooth}")
    except ConfigError as error:
        raise ConfigError(f"robot {robot.name}: {error}") from None
