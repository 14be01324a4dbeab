"""Builds the lab's machine from Debian packages and our own release, and keeps it by its content.

Each part is in a folder of the cache named by a hash of all that goes into it: `kernel-*`, `base-*` (Debian's root) and
`image-*` (the disk with the agent and the release in it). A changed source makes a new image in less than a minute and
leaves the others. The same packages give the same bytes; `SWARM_LAB_MIRROR` may name a mirror that stands still, as
snapshot.debian.org does.
"""

import contextlib
import fcntl
import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from lab import container
from lab.vm import debian, kernel, recipe
from lab.vm.shell import sh
from lab.waiting import until
from swarm.errors import LocalError

ROOT = Path(__file__).parents[2]
RELEASED = (
    "swarm",
    "services",
    "sim",
    "laptop",
    "deploy",
    "pyproject.toml",
    "README.md",
    "LICENSE",
    "requirements-robot.lock",
)
"""What a release is made of (deploy/release)."""

TOOLS = {
    "mmdebstrap": "mmdebstrap",
    "systemd-nspawn": "systemd-container",
    "gcc": "gcc",
    "make": "make",
    "flex": "flex",
    "bison": "bison",
    "bc": "bc",
    "patch": "patch",
    "xz": "xz-utils",
    "mke2fs": "e2fsprogs",
    "depmod": "kmod",
    "ip": "iproute2",
    "ssh-keygen": "openssh-client",
}
"""Programs that the lab needs, and the Debian packages that have them."""

TUN = Path("/dev/net/tun")

LOCK_S = 7200.0
"""Seconds for which a build waits for one of the same kind by another process."""


class UnableError(LocalError):
    """This host lacks something that the lab needs; says what, and how to get it."""


@dataclass(frozen=True)
class Image:
    """What a machine boots from; never written to."""

    disk: Path
    kernel: Path
    """A program of the host."""
    key: Path
    """Private ssh key that root inside accepts."""


def missing() -> str:
    """What this host lacks to run the lab, and how to get it; empty where it lacks nothing."""
    if os.geteuid() != 0:
        return "the lab must be root: it makes Debian roots and boots them"
    if platform.machine() != recipe.MACHINE:
        return f"the lab's machines run on {recipe.MACHINE}, this is {platform.machine()}"
    if not TUN.exists():
        return f"there is no {TUN}, by which the lab's machines have a network: modprobe tun"
    packages = sorted(package for tool, package in TOOLS.items() if shutil.which(tool) is None)
    return f"apt-get install {' '.join(packages)}" if packages else ""


def cache() -> Path:
    """The folder in which machines are kept."""
    named = os.environ.get("SWARM_LAB_CACHE")
    return Path(named) if named else Path.home() / ".cache/balboa-swarm/lab"


def image() -> Image:
    """The machine with the sources of this checkout; built where it is not there yet (some two minutes). Raises
    `UnableError`, and `LocalError` where it cannot be built."""
    if lacking := missing():
        raise UnableError(f"this host cannot run the lab: {lacking}")
    mirror = os.environ.get("SWARM_LAB_MIRROR", recipe.MIRROR)
    of_system = (Path(recipe.__file__), Path(debian.__file__))
    of_core = (Path(kernel.__file__), kernel.CONFIG, *kernel.PATCHES)
    system = "base-" + recipe.digest(mirror, *map(Path.read_bytes, of_system))
    core = "kernel-" + recipe.digest(mirror, *map(Path.read_bytes, of_core))
    parts = [ROOT / name for name in RELEASED] + [recipe.GUEST, Path(__file__), Path(container.__file__)]
    name = "image-" + recipe.digest(system, core, *map(_content, parts))
    with ThreadPoolExecutor() as pool:
        linux = pool.submit(kept, cache() / core, lambda folder: kernel.make(folder, mirror))
        root = pool.submit(kept, cache() / system, lambda folder: debian.make(folder, mirror))
        made = kept(cache() / name, lambda folder: _image(folder, root, linux))
    return Image(made / "disk.ext4", linux.result() / "linux", made / "ssh_key")


def _content(path: Path) -> bytes:
    """All bytes of a file, or of a folder's sources."""
    if path.is_file():
        return path.read_bytes()
    inner = [each for each in path.rglob("*") if each.is_dir() and each.name != "__pycache__"]
    return recipe.sources(path, *inner)


# -- the cache ---------------------------------------------------------------------------------------------------


def kept(wanted: Path, make: Callable[[Path], None]) -> Path:
    """That folder of a cache, KIND-DIGEST; made by `make` where it is not there, complete or not at all. Older ones of
    its kind go, but for those that were used within a day: another checkout may boot from them."""
    folder = wanted.parent
    folder.mkdir(parents=True, exist_ok=True)
    kind = wanted.name.split("-")[0]
    with _locked(folder / f"{kind}.lock"):
        if not wanted.is_dir():
            with tempfile.TemporaryDirectory(dir=folder, prefix="making-") as work:
                made = Path(work) / "made"
                made.mkdir()
                make(made)
                made.rename(wanted)
        os.utime(wanted)
        newest = wanted.stat().st_mtime
        for old in folder.glob(f"{kind}-*"):
            if old.stat().st_mtime < newest - 86400:
                shutil.rmtree(old)
    return wanted


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        until(f"another process has made its {path.stem}", lambda: _lock(file), LOCK_S, every=0.2)
        yield


def _lock(file: IO[str]) -> bool:
    with contextlib.suppress(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    return False


# -- our release in it -------------------------------------------------------------------------------------------


INSTALL = """
set -eu
mkdir -p /run/lab /etc/systemd/system/swarm-balancer.service.d
printf '%s\\n' '[Service]' 'Environment=PYTHONPATH=/opt/release/simulated' 'ExecStart=' \
    'ExecStart=/opt/swarm/current/bin/python -m sim.body' \
    >/etc/systemd/system/swarm-balancer.service.d/90-lab.conf
/opt/release/install --name r0 --config /opt/release/lab.toml
systemctl disable --quiet swarm.target swarm-bus swarm-mesh swarm-balancer swarm-dwm
rm /etc/systemd/system/swarm-balancer.service.d/90-lab.conf /etc/swarm/swarm.toml /etc/swarm/robot.env
"""
"""The release's own installation, which looks whether all services run; then no robot is made of it yet: a test that
wants one runs /opt/release/install again, which finds the release unpacked."""

NO_MODULE = "/dev/ttyS9"
CONFIG = f"""network = "lab"
[topology]
edges = []
[[robots]]
name = "r0"
link = "tcp:127.0.0.1:5501"
[mesh]
listen = "127.0.0.1:5501"
[dwm]
source = "serial:{NO_MODULE}"
"""
"""Of a robot alone."""


def _image(folder: Path, base: Future[Path], linux: Future[Path]) -> None:
    """disk.ext4: the root with the release installed, by its own `install` under systemd in a container. The release is
    made while the base may still be on its way."""
    artefact = sh(ROOT / "deploy/release", "--machine", recipe.MACHINE, "--python", recipe.PYTHON, folder).split()[-1]
    sh("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "lab", "-f", folder / "ssh_key")
    root = folder / "root"
    root.mkdir()
    sh("tar", "-C", root, "-xf", base.result() / "root.tar")
    _furnish(root, (folder / "ssh_key.pub").read_text())
    unpacked = root / "opt/release"
    unpacked.mkdir(parents=True)
    sh("tar", "-C", unpacked, "--strip-components=1", "-xf", artefact)
    Path(artefact).unlink()
    (unpacked / "lab.toml").write_text(CONFIG)
    shutil.copytree(ROOT / "sim", unpacked / "simulated/sim", ignore=shutil.ignore_patterns("__pycache__"))
    code, said = container.boot(root, INSTALL, 300)
    if code:
        raise LocalError(f"the release could not be installed in the lab's machine: {said[-2000:]}")
    shutil.rmtree(root / "var/log/journal", ignore_errors=True)
    for made in (linux.result() / "modules").iterdir():
        shutil.copytree(made, root / "usr/lib/modules" / made.name)
        sh("depmod", "-b", root, made.name)
    disk = folder / "disk.ext4"
    options = "hash_seed=0c1d0000-0000-4000-8000-000000000001,root_owner=0:0"
    uuid = "0c1d0000-0000-4000-8000-000000000002"
    sh("mke2fs", "-q", "-t", "ext4", "-U", uuid, "-E", options, "-d", root, disk, f"{recipe.DISK_MB}M")
    shutil.rmtree(root)


def _furnish(root: Path, public_key: str) -> None:
    """What makes a Debian root a lab machine: the agent, ssh for the lab's key, nothing that only costs time."""
    etc = root / "etc"
    place = root / "usr/lib/lab"
    place.mkdir(exist_ok=True)
    for name in ("agent.py", "radio.py", "init"):
        shutil.copy(recipe.GUEST / name, place / name)
    (place / "init").chmod(0o755)
    units = etc / "systemd/system"
    for target, unit in (("sysinit", "lab-agent.service"), ("multi-user", "lab-radio.service")):
        shutil.copy(recipe.GUEST / unit, units / unit)
        _linked(units / f"{target}.target.wants" / unit, f"/etc/systemd/system/{unit}")
    for name in recipe.MASKED:
        _linked(units / name, "/dev/null")
    for each in (root / "usr/lib/systemd/system-generators").iterdir():
        _linked(etc / "systemd/system-generators" / each.name, "/dev/null")
    _linked(units / "default.target", "/lib/systemd/system/multi-user.target")
    # A fixed identity saves the work of a first boot; ssh host keys are in the image from the package.
    (etc / "machine-id").write_text("0123456789abcdef0123456789abcdef\n")
    (etc / "fstab").write_text("")
    (root / "share").mkdir(exist_ok=True)
    keys = root / "root/.ssh/authorized_keys"
    keys.parent.mkdir(mode=0o700, exist_ok=True)
    keys.write_text(public_key)
    (etc / "ssh/sshd_config.d/lab.conf").write_text("PermitRootLogin prohibit-password\nUsePAM no\nUseDNS no\n")


def _linked(link: Path, to: str) -> None:
    link.parent.mkdir(exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(to)
