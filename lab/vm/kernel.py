"""The lab's kernel: Debian's own source of Linux 6.12, built as a program of the host (User Mode Linux).

Its programs run on the host's processor at full speed, one host process for the memory of each, so a machine needs
neither a processor that is emulated nor KVM. Bluetooth, RFCOMM, the character devices, control groups and file
systems are the source's that Debian's kernel is made of. Debian's own package of such a kernel has no Bluetooth.
"""

import os
import shutil
import sys
from pathlib import Path

from lab.vm import recipe
from lab.vm.shell import sh
from swarm.errors import LocalError

HERE = Path(__file__).parent
CONFIG = HERE / "kernel.config"
PATCHES = (HERE / "xstate.patch", HERE / "serial.patch")
"""Faults of Linux as a program that a later version does not have, or that meet our use of it; each says which."""
SOURCE = "linux-source-6.12"
BUILTIN = ("modules.builtin", "modules.builtin.modinfo")
"""What lets modprobe know that all of it is there already."""


def make(folder: Path, mirror: str) -> None:
    """`linux`, the kernel as a program, and `modules`, the folder /usr/lib/modules/VERSION of its machines."""
    sys.stderr.write("lab: building the kernel, five minutes of two cores; it is kept\n")
    package = folder / "package"
    sh("mmdebstrap", "--quiet", "--variant=extract", f"--include={SOURCE}", recipe.SUITE, package, mirror)
    sh("tar", "-C", folder, "-xf", package / f"usr/src/{SOURCE}.tar.xz")
    shutil.rmtree(package)
    source = folder / SOURCE
    for fault in PATCHES:
        sh("patch", "--quiet", "--strip=1", f"--directory={source}", f"--input={fault}")
    words = ("make", "--silent", f"--directory={source}", "ARCH=um", "KBUILD_BUILD_USER=lab", "KBUILD_BUILD_HOST=lab")
    stamp = f"KBUILD_BUILD_TIMESTAMP=@{recipe.EPOCH}"
    sh(*words, "allnoconfig", f"KCONFIG_ALLCONFIG={CONFIG}")
    _check(source / ".config")
    sh(*words, stamp, f"--jobs={os.cpu_count()}", "linux")
    shutil.move(source / "linux", folder / "linux")
    version = (source / "include/config/kernel.release").read_text().strip()
    modules = folder / "modules" / version
    modules.mkdir(parents=True)
    for name in BUILTIN:
        shutil.move(source / name, modules / name)
    (modules / "modules.order").touch()
    shutil.rmtree(source)


def _check(made: Path) -> None:
    """Whether all that we want has come into the configuration: what lacks a condition is left out without a word."""
    there = set(made.read_text().splitlines())
    wanted = [line for line in CONFIG.read_text().splitlines() if line.startswith("CONFIG_")]
    if lost := [line for line in wanted if line not in there]:
        raise LocalError(f"{CONFIG.name}: the kernel's source has no {', '.join(lost)}, or lacks what it depends on")
