"""Making a release: everything that a robot needs, so that the robot itself needs no internet.

It is made of this checkout, or of the installed package that this module belongs to: the wheel of what a robot carries
(`swarm` and `services`), the locked packages and those of `[robot] packages` as wheels for the robot's processor and
Python, the units and `install`. It needs pip and, where no earlier release has had the same packages, a network.
The same sources and packages give the same ID.

    deploy/release [--machine aarch64] [--python 3.11] [--package numpy] [FOLDER]

writes FOLDER/balboa-swarm-ID.tar.gz (FOLDER: dist) and prints its path. Raspberry Pi OS is aarch64, with Python 3.11
(Bookworm) or 3.13 (Trixie); the defaults are those of this computer.
"""

import argparse
import base64
import gzip
import hashlib
import io
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import swarm
from laptop.fleet.release.install import pack
from swarm.errors import LocalError
from swarm.files import atomic_write
from swarm.onboard.command_line import end_with
from swarm.packages import HOME, PARTS

MACHINES = ("aarch64", "x86_64")

LOCK = "requirements-robot.lock"
FIRMWARE = PARTS / "firmware" / "balboa.hex"
"""The Balboa's firmware, made from its sources (firmware/Makefile)."""

_PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux2014", "manylinux_2_17")
"""Platform names of wheels for glibc 2.28 and older; Bookworm has 2.36."""
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
_TAR_TIME = 315532800
"""The time of all files in the archive, in seconds since 1970. It is constant, so that equal sources give equal
bytes."""


def build(folder: Path, machine: str, python: str, packages: Sequence[str] = (), *, lock: Path = PARTS / LOCK) -> Path:
    """Make the release for robots with this processor and Python (like 3.11) in `folder`, and return its path.

    `packages`: further ones as pip names them, with all that they need. Raises `LocalError` where it cannot be made.
    """
    locked, wheels = _wheels(lock.read_text(), machine, python, packages)
    name, data = robot_wheel()
    files = {f"wheels/{path.name}": path.read_bytes() for path in wheels}
    files |= {f"wheels/{name}": data, LOCK: locked.encode(), "FOR": f"{machine} {python}\n".encode()}
    deploy = PARTS / "deploy"
    paths = [deploy / "install", deploy / "uninstall", *sorted((deploy / "systemd").rglob("*"))]
    files |= {str(path.relative_to(deploy)): path.read_bytes() for path in paths if path.is_file()}
    sums = "".join(f"{hashlib.sha256(files[name]).hexdigest()}  {name}\n" for name in sorted(files))
    identity = f"{swarm.__version__}-{hashlib.sha256(sums.encode()).hexdigest()[:12]}"
    files["ID"] = f"{identity}\n".encode()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"balboa-swarm-{identity}.tar.gz"
    atomic_write(path, _archive(f"balboa-swarm-{identity}", files))
    return path


def robot_wheel() -> tuple[str, bytes]:
    """Return file name and content of the wheel of what a robot carries, by `deploy/robot/pyproject.toml`."""
    whole = tomllib.loads((PARTS / "deploy/robot/pyproject.toml").read_text())
    project = whole["project"]
    files = {
        str(path.relative_to(HOME)): path.read_bytes()
        for package in whole["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
        for path in sorted((HOME / package).rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
    }
    stem = f"balboa_swarm-{swarm.__version__}"
    scripts = "".join(f"{name} = {place}\n" for name, place in project["scripts"].items())
    files |= {
        f"{stem}.dist-info/METADATA": (
            f"Metadata-Version: 2.4\nName: {project['name']}\nVersion: {swarm.__version__}\n"
            f"Summary: {project['description']}\nLicense-Expression: {project['license']}\n"
            f"License-File: LICENSE\nRequires-Python: {project['requires-python']}\n"
        ).encode(),
        f"{stem}.dist-info/WHEEL": b"Wheel-Version: 1.0\nGenerator: balboa-swarm\n"
        b"Root-Is-Purelib: true\nTag: py3-none-any\n",
        f"{stem}.dist-info/entry_points.txt": f"[console_scripts]\n{scripts}".encode(),
        f"{stem}.dist-info/licenses/LICENSE": (PARTS / "LICENSE").read_bytes(),
    }
    record = "".join(f"{name},sha256={_record_hash(data)},{len(data)}\n" for name, data in files.items())
    files[f"{stem}.dist-info/RECORD"] = f"{record}{stem}.dist-info/RECORD,,\n".encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, _ZIP_TIME)
            entry.external_attr = 0o100644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)
    return f"{stem}-py3-none-any.whl", buffer.getvalue()


def _record_hash(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()


def _archive(root: str, files: Mapping[str, bytes]) -> bytes:
    paths = {f"{root}/{name}": files[name] for name in sorted(files)}
    modes = {f"{root}/{name}": 0o755 if name in ("install", "uninstall") else 0o644 for name in files}
    return gzip.compress(pack(paths, modes, _TAR_TIME), 9, mtime=0)


# -- packages --------------------------------------------------------------------------------------------------------


def _wheels(lock: str, machine: str, python: str, packages: Sequence[str]) -> tuple[str, list[Path]]:
    """Return a lock of the locked and the further packages, and their files.

    They are kept in the user's cache, so a release of the same packages needs no network.
    """
    key = hashlib.sha256("\n".join([machine, python, *packages, lock]).encode()).hexdigest()[:16]
    folder = _cache() / "wheels" / key
    if not (folder / LOCK).is_file():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as name:
            new = Path(name) / "new"
            new.mkdir()
            (new / LOCK).write_text(_download(new, lock, machine, python, packages))
            shutil.rmtree(folder, ignore_errors=True)
            new.rename(folder)
    return (folder / LOCK).read_text(), sorted(folder.glob("*.whl"))


def _download(folder: Path, lock: str, machine: str, python: str, packages: Sequence[str]) -> str:
    """Bring all wheels into `folder`, and return the lock of all of them."""
    own = folder.parent / "own.lock"
    own.write_text(lock)
    target = ["--only-binary", ":all:", "--python-version", python, "--implementation", "cp", "--dest", str(folder)]
    for each in _PLATFORMS:
        target += ["--platform", f"{each}_{machine}"]
    _pip("download", *target, "--no-deps", "--require-hashes", "-r", str(own))
    before = set(folder.glob("*.whl"))
    if packages:
        pins = folder.parent / "pins.txt"  # what a further package needs of ours has the version that is locked
        pins.write_text("".join(f"{pin}\n" for pin in re.findall(r"^([A-Za-z0-9._-]+==\S+)", lock, re.M)))
        _pip("download", *target, "--constraint", str(pins), "--", *packages)
    new = [path for path in sorted(folder.glob("*.whl")) if path not in before]
    lines = (
        f"{path.name.split('-')[0]}=={path.name.split('-')[1]} "
        f"--hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n"
        for path in new
    )
    return lock + "".join(lines)


def _pip(*words: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return
    if "No module named pip" in done.stderr:
        raise LocalError("a release is made with pip, which this Python lacks: python3 -m ensurepip, or python3-pip")
    errors = [line.removeprefix("ERROR: ") for line in done.stderr.splitlines() if line.startswith("ERROR")]
    said = "; ".join(errors[-2:]) or done.stderr.strip()[-300:]
    raise LocalError(f"the robots' packages cannot be downloaded ({said}); is the network there?")


def _cache() -> Path:
    own = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (own if own.is_absolute() else Path.home() / ".cache") / "balboa-swarm"


# -- command ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    """Make one release and print its path."""
    parser = argparse.ArgumentParser(prog="deploy/release", description="make a release for robots, print its path")
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path("dist"), metavar="FOLDER", help="folder for the release (dist)"
    )
    parser.add_argument("--machine", choices=MACHINES, default=platform.machine(), help="of the robots (%(default)s)")
    here = ".".join(platform.python_version_tuple()[:2])
    parser.add_argument("--python", default=here, metavar="3.N", help="of the robots (%(default)s)")
    parser.add_argument(
        "--package", action="append", default=[], metavar="NAME", help="a further Python package, such as numpy"
    )
    args = parser.parse_args(argv)
    if not re.fullmatch(r"3\.[0-9]+", args.python):
        parser.error(f"--python {args.python}: expected a version like 3.11")
    sys.stdout.write(f"{build(args.folder.absolute(), args.machine, args.python, args.package)}\n")
    return 0


if __name__ == "__main__":
    end_with("release", main)
