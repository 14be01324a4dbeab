"""The desired state of a provisioned robot, and the result of a step: what it found and what it would change."""

from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Any

from swarm.config.types import DEFAULT_KEY_FILE, Config
from swarm.frozen import frozen

SUITES = {"bookworm": "3.11", "trixie": "3.13"}
"""The supported Debian releases of Raspberry Pi OS, with their versions of Python."""

BOARDS = {"Raspberry Pi Zero 2 W": "zero2w", "Raspberry Pi 4 Model B": "pi4"}
"""The beginning of a board's name in the device tree, and its name for `board` in swarm.toml."""

PACKAGES = ("bluez", "python3", "python3-bluez", "python3-venv", "rfkill")
"""Packages that every robot needs. python3-bluez is the version of PyBluez that works, and the release's environment
can import it."""

FIRMWARE_PACKAGE = "bluez-firmware"
"""The package of Raspberry Pi's archive with the Bluetooth firmware of its boards."""

MIN_KERNEL = (6, 12)
"""6.1 crashes (krfcommd) when an RFCOMM call meets a page time-out; 6.12 is the oldest that was tested not to."""

KERNEL_PACKAGE = "linux-image-rpi-v8"

MIN_FREE = {"/": 400_000_000, "/boot/firmware": 20_000_000}
"""Free bytes that a robot needs: a release has 60 MB, one is in force while another is unpacked, and packages need
room too."""


@frozen
class Packages:
    """The changes that apt would make on the robot with the bundle's packages."""

    files: Mapping[str, int] = field(default_factory=dict)
    """Size in bytes of the bundle's files that the robot lacks, by name; empty: it has all of them."""
    problem: str = ""
    names: tuple[str, ...] = ()
    """All packages that the bundle holds."""


@frozen
class DesiredRobot:
    """The desired state of one robot."""

    robot: str
    board: str
    """The board as in swarm.toml: zero2w or pi4."""
    address: str
    """The address by which ssh reaches the robot."""
    now: float
    """The time, in seconds since 1970."""
    uart: str | None = None
    """The port of the Pi's own UART to which the DWM1001 is wired; None: it is connected elsewhere."""
    bluetooth: bool = True
    """Whether the robot's links use Bluetooth."""
    key: bool = False
    """Whether this run brings a key to the robot."""
    i2c_clock: int = 100
    """The clock of the I2C bus, kHz."""
    key_file: str | None = DEFAULT_KEY_FILE
    """Where the robot's mesh looks for its key; None: it needs none."""
    wifi: tuple[str, str] | None = None
    """Name and password of a wireless network to join."""
    architecture: str = "arm64"
    packages: tuple[str, ...] = PACKAGES
    bundle: Packages | None = None
    """The bundle for this robot's Debian; None if there is none."""


def wish(
    config: Config, robot: str, address: str, now: float, *, key: bool, wifi: tuple[str, str] | None
) -> DesiredRobot:
    """Return the desired state of a robot by swarm.toml."""
    entry = config.robot(robot)
    kind, _, port = config.dwm.source.partition(":")
    own = kind == "serial" and port in ("/dev/serial0", "/dev/ttyAMA0", "/dev/ttyS0")
    return DesiredRobot(
        robot=robot,
        board=entry.board,
        address=address,
        now=now,
        uart=port if own else None,
        bluetooth=entry.link is None,
        key=key,
        i2c_clock=entry.i2c_clock,
        key_file=None if config.mesh.key_file is None else str(config.mesh.key_file),
        wifi=wifi,
    )


Facts = Mapping[str, Any]
Change = dict[str, Any]
"""A change in the form that `swarm.onboard.bootstrap.changes` takes."""


@frozen
class Verdict:
    """The result of a step's look at a robot."""

    state: str
    """ok, change or failed."""
    text: str
    """By state: what is in order, what will be changed, or what is wrong and how to repair it."""
    changes: tuple[Change, ...] = ()
    reboot: bool = False
    """Whether the change is in force only after a reboot."""


def ok(text: str) -> Verdict:
    """Return the verdict that nothing has to be changed."""
    return Verdict("ok", text)


def failed(text: str) -> Verdict:
    """Return the verdict that something is wrong and that we cannot repair it."""
    return Verdict("failed", text)


def change(text: str, *changes: Change, reboot: bool = False) -> Verdict:
    """Return the verdict that these changes repair what is wrong."""
    return Verdict("change", text, changes, reboot)


@frozen
class ProvisioningStep:
    """One step of provisioning."""

    name: str
    judge: Callable[[Facts, DesiredRobot], Verdict]
