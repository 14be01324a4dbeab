"""Machines that need not boot: the state of one that has booted is kept in the cache, and others go on from there.

Booting is most of what a short test costs an emulated machine, and importing modules is most of the rest. So what is
saved has booted, has its modules loaded and the release's Python warm (guest/warm.py). What must not be the same in two
machines they get when they go on: name, time, random numbers, disk, /share, controller. Each kind of machine boots
where it is saved, and after a power cut; that booting works is for tests with machines that are not saved.
"""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from lab.vm import machine as module
from lab.vm import recipe
from lab.vm.build import Image, kept
from lab.vm.machine import PLAIN, Machine

PREPARE = """
set -e
modprobe -a rfcomm hci_vhci
/opt/swarm/current/bin/python /usr/lib/lab/warm.py </dev/null >/dev/null 2>&1 &
until [ -S /run/lab-warm ]; do sleep 0.1; done
umount /share
"""


def machine(
    image: Image,
    folder: Path,
    name: str,
    *,
    memory_mb: int = 384,
    alone: bool = False,
    radio: Path | None = None,
) -> Machine:
    """A plain machine that has booted when it is switched on; the first of its kind boots and is saved."""
    parts = [Path(__file__), Path(module.__file__)]
    version = subprocess.run(["qemu-system-x86_64", "--version"], capture_output=True, check=True).stdout
    known = f"{image.disk.parent.name} {memory_mb} {os.environ.get('SWARM_LAB_ACCEL')}"
    digest = recipe.digest(known, version, *map(Path.read_bytes, parts))

    def make(made: Path) -> None:
        with tempfile.TemporaryDirectory(prefix="lab-", dir="/tmp") as work:  # a short path for the sockets in it
            first = Machine(image, Path(work), "lab", init=PLAIN, memory_mb=memory_mb, alone=alone)
            with first:
                first.run(PREPARE, 600)
                shutil.move(first.save(), made / "disk.qcow2")

    kind = "alone" if alone else "plain"
    # Beside its image: within a test the variable that names the cache is hidden.
    saved = kept(image.disk.parents[1] / f"saved.{kind}-{digest}", make) / "disk.qcow2"
    return Machine(image, folder, name, init=PLAIN, memory_mb=memory_mb, alone=alone, radio=radio, saved=saved)
