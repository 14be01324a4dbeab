"""Disks of robots: the machine's disk, where the release is installed already, with what makes it a robot written into
it: the config, the key, the units switched on, and the lab's I2C bus and module in place of the soldered ones.

Written by debugfs(8) into the file system's image: nothing is mounted, and a robot's first boot is one like any other.
Who it is the machine says (its host's name), so one disk does for all robots of a swarm.
"""

import dataclasses
import subprocess
from collections.abc import Iterable
from pathlib import Path

import lab
from lab.vm.build import Image
from swarm.errors import LocalError

UNITS = "/etc/systemd/system"
RELEASED = "/usr/local/lib/systemd/system"
"""Where the release's own units are found."""
OURS = ("lab-parts", "lab-scan")
SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm", *OURS)
HERE = Path(__file__).parent
PLACE = "/opt/lab"
"""Of this package inside."""
CARRIED = ("__init__.py", "waiting.py", "i2c/*.py", "robot/__init__.py", "robot/__main__.py", "robot/module.py")
FIRMWARE = f"{PLACE}/firmware-built"
SIMULATOR = ("firmware/layout.h", "tests/firmware/firmware_layout.py", "tests/firmware/avr_bench.py")
"""The AVR simulator's binding, and what it reads."""
WITH_FIRMWARE = f"""[Service]
Environment=LAB_FIRMWARE={FIRMWARE} LD_LIBRARY_PATH={FIRMWARE} PYTHONPATH={PLACE}:{PLACE}/tests/firmware
"""
KEY_MODE = 0o100600
NICENESS = -10
"""Of a machine with such a disk, on the host: its body falls in real time. A robot has a processor of its own; those of
the host are shared by machines and tests, and a balancer that waits for them lies on the ground."""


class Disk:
    """What is to be written, then all at once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._orders: list[str] = []
        self._folders: set[str] = set()

    def read(self, path: str) -> str:
        """A text file of it."""
        return self._run("-R", f"cat {path}")

    def folder(self, path: str) -> None:
        """A folder and those above it; one that is there stays."""
        for above in [*reversed([str(each) for each in Path(path).parents]), path]:
            if above not in ("/", *self._folders):
                self._folders.add(above)
                self._orders.append(f"mkdir {above}")

    def file(self, source: Path, path: str, *, mode: int | None = None, uid: int = 0) -> None:
        """A file in place of one that may be there."""
        self.folder(str(Path(path).parent))
        self._orders += [f"rm {path}", f"write {source} {path}"]
        if mode is not None:
            self._orders += [f"set_inode_field {path} mode {mode:#o}", f"set_inode_field {path} uid {uid}"]

    def link(self, path: str, to: str) -> None:
        """A symbolic link."""
        self.folder(str(Path(path).parent))
        self._orders.append(f"symlink {path} {to}")

    def finish(self) -> None:
        """Write it; raises `LocalError` where the file system is not in order then."""
        orders = self._path.with_suffix(".orders")
        orders.write_text("\n".join(self._orders) + "\n")
        self._run("-w", "-f", str(orders))
        orders.unlink()
        checked = subprocess.run(["e2fsck", "-fn", str(self._path)], capture_output=True, text=True, check=False)
        if checked.returncode:
            raise LocalError(f"{self._path}: {checked.stdout[-1000:]}")

    def _run(self, *words: str) -> str:
        return subprocess.run(["debugfs", *words, str(self._path)], capture_output=True, text=True, check=True).stdout


def robots(image: Image, folder: Path, config: str, key: Path, firmware: Iterable[Path] = ()) -> Image:
    """The image of a swarm's robots, in that folder. `firmware`: balboa.elf, libbench.so and the libraries that the
    machine lacks for it; then the ATmega is the firmware in the AVR simulator."""
    disk, made = _copy(image, folder)
    (folder / "swarm.toml").write_text(config)
    uids = {line.split(":")[0]: int(line.split(":")[2]) for line in disk.read("/etc/passwd").splitlines()}
    disk.file(folder / "swarm.toml", "/etc/swarm/swarm.toml")
    disk.file(key, "/etc/swarm/key", mode=KEY_MODE, uid=uids["swarm-mesh"])
    _solder(disk)
    if firmware := [*firmware]:
        for source in firmware:
            disk.file(source, f"{FIRMWARE}/{source.name}")
        for name in SIMULATOR:
            disk.file(Path(lab.__file__).parents[1] / name, f"{PLACE}/{name}")
        (folder / "firmware.conf").write_text(WITH_FIRMWARE)
        disk.file(folder / "firmware.conf", f"{UNITS}/lab-parts.service.d/firmware.conf")
    disk.link(f"{UNITS}/multi-user.target.wants/swarm.target", f"{RELEASED}/swarm.target")
    for unit in SERVICES:
        place = UNITS if unit in OURS else RELEASED
        disk.link(f"{UNITS}/swarm.target.wants/{unit}.service", f"{place}/{unit}.service")
    disk.finish()
    return made


def provisioned(image: Image, folder: Path) -> Image:
    """The image of robots as `swarm provision` leaves them before they are paired: all packages, no config, no key, no
    service switched on. What is soldered on is there once the services are."""
    disk, made = _copy(image, folder)
    _solder(disk)
    disk.link(f"{UNITS}/swarm.target.wants/lab-parts.service", f"{UNITS}/lab-parts.service")
    disk.finish()
    return made


def _copy(image: Image, folder: Path) -> tuple[Disk, Image]:
    """A disk like the image's in that folder, and the image of it."""
    path = folder / "robots.ext4"
    subprocess.run(["cp", "--sparse=always", str(image.disk), str(path)], check=True)
    return Disk(path), dataclasses.replace(image, disk=path)


def _solder(disk: Disk) -> None:
    """The lab's parts in place of the soldered ones, and the units that serve them, switched off."""
    ours = Path(lab.__file__).parent
    for pattern in CARRIED:
        for source in ours.glob(pattern):
            disk.file(source, f"{PLACE}/lab/{source.relative_to(ours)}")
    for pattern in ("sim/**/*.py", "laptop/**/*.py"):  # robots carry neither; the devices are simulated
        for source in ours.parent.glob(pattern):
            disk.file(source, f"{PLACE}/{source.relative_to(ours.parent)}")
    for unit in OURS:
        disk.file(HERE / f"units/{unit}.service", f"{UNITS}/{unit}.service")
    disk.file(HERE / "units/balancer.conf", f"{UNITS}/swarm-balancer.service.d/90-lab.conf")
