"""The desired state of a provisioned robot, and the result of a step: what it found and what it would change."""

from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Any

from swarm.config.types import Config
from swarm.frozen import frozen

SUITES = {"bookworm": "3.11", "trixie": "3.13"}
"""Raspberry Pi OS: its Debian's name, and that one's Python."""

BOARDS = {"Raspberry Pi Zero 2 W": "zero2w", "Raspberry Pi 4 Model B": "pi4"}
"""Beginning of what the device tree calls a board, and what `board` in swarm.toml does."""

PACKAGES = ("bluez", "python3", "python3-bluez", "python3-venv", "rfkill")
"""What every robot needs; python3-bluez is the PyBluez that works, seen by the release's environment."""

FIRMWARE_PACKAGE = "bluez-firmware"
"""Of Raspberry Pi's archive: the Bluetooth firmware of its boards."""

MIN_KERNEL = (6, 12)
"""6.1 crashes (krfcommd) when an RFCOMM call meets a page time-out; 6.12 is the oldest that was tested not to."""

KERNEL_PACKAGE = "linux-image-rpi-v8"

MIN_FREE = {"/": 400_000_000, "/boot/firmware": 20_000_000}
"""Bytes: a release is 60 MB unpacked, two are kept, one more is being unpacked, and packages beside."""


@frozen
class Packages:
    """The changes that apt would make on the robot with the bundle's packages."""

    files: Mapping[str, int] = field(default_factory=dict)
    """Bytes by file of the bundle; nothing = all is there."""
    problem: str = ""
    names: tuple[str, ...] = ()
    """All packages that the bundle holds."""


@frozen
class DesiredRobot:
    """The desired state of one robot."""

    robot: str
    board: str
    """As in swarm.toml: zero2w, pi4."""
    address: str
    """How ssh reaches it."""
    now: float
    """Seconds since 1970."""
    uart: str | None = None
    """A port of the Pi's own UART that the DWM1001 is wired to; None = it hangs elsewhere."""
    bluetooth: bool = True
    """Whether its links are Bluetooth's."""
    key: bool = False
    """Whether a key is brought."""
    i2c_clock: int = 100
    """kHz of the I2C bus."""
    secure: bool = True
    """Whether one is needed."""
    wifi: tuple[str, str] | None = None
    """Name and password of a wireless network to join."""
    architecture: str = "arm64"
    packages: tuple[str, ...] = PACKAGES
    bundle: Packages | None = None
    """None = no bundle for this robot's Debian."""


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
        secure=config.mesh.key_file is not None,
        wifi=wifi,
    )


Facts = Mapping[str, Any]
Change = dict[str, Any]
"""As `swarm.onboard.bootstrap.changes` takes it."""


@frozen
class Verdict:
    """The result of a step's look at a robot."""

    state: str
    """ok, change or failed."""
    text: str
    """What is so; what will be changed; what is wrong and how to mend it."""
    changes: tuple[Change, ...] = ()
    reboot: bool = False
    """In force only after a reboot."""


def ok(text: str) -> Verdict:
    """It is as it should be."""
    return Verdict("ok", text)


def failed(text: str) -> Verdict:
    """It is not, and no change of ours helps."""
    return Verdict("failed", text)


def change(text: str, *changes: Change, reboot: bool = False) -> Verdict:
    """It is not, and these changes help."""
    return Verdict("change", text, changes, reboot)


@frozen
class ProvisioningStep:
    """One step of provisioning."""

    name: str
    judge: Callable[[Facts, DesiredRobot], Verdict]
