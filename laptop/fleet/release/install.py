"""A release, config and key onto one robot, and the switch to it, by the release's own `install`.

The robot keeps the unpacked release in ~/.cache/balboa-swarm. It compares checksums; what differs or is missing is sent
as one tar stream and compared again, so what breaks in mid-transfer costs the rest of it and nothing else.
"""

import gzip
import hashlib
import io
import re
import shlex
import tarfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from laptop.fleet.ssh.everyone import ReportProgress
from laptop.fleet.ssh.ssh import Host, HostError, Ssh, last_words
from swarm.config import Config
from swarm.config.keyfile import read_keys
from swarm.config.types import DEFAULT_KEY_FILE
from swarm.errors import LocalError
from swarm.frozen import frozen

FOLDER = ".cache/balboa-swarm"
"""The folder on the robot, below the home of the user who logs in."""

_LACKS = f"""set -e; umask 022; export LC_ALL=C; mkdir -p {FOLDER}; cd {FOLDER}; cat > SUMS
sha256sum --check --quiet SUMS 2>/dev/null | sed -n 's/: FAILED.*//p'
find . -type f ! -name SUMS | cut -c3- | while read -r name; do
    grep -qF "  $name" SUMS || rm -f "$name"
done"""
"""A program for the robot. It prints the names of files that are missing or differ, and removes files of other
releases."""


@frozen
class Release:
    """A release in memory, as `laptop.fleet.release` makes it."""

    path: Path
    identity: str
    machine: str
    python: str
    files: dict[str, bytes]
    """The content of each file, by name."""
    modes: dict[str, int]

    @property
    def sums(self) -> bytes:
        """Return the input of `sha256sum --check`."""
        lines = (f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in sorted(self.files.items()))
        return "".join(lines).encode()

    def lacks(self, packages: Iterable[str]) -> list[str]:
        """Return those of `[robot] packages` of which the release has no wheel."""
        there = {_plain(name.removeprefix("wheels/").partition("-")[0]) for name in self.files if name.endswith(".whl")}
        return [each for each in packages if _plain(_NAME.match(each)[0]) not in there]  # type: ignore[index]


_NAME = re.compile(r"[A-Za-z0-9._-]+")


def _plain(name: str) -> str:
    """Return a package's name as pip compares it."""
    return re.sub(r"[-_.]+", "_", name).lower()


def pack(files: Mapping[str, bytes], modes: Mapping[str, int], time: int = 0) -> bytes:
    """Pack files as a tar, in which only the owner can read those without a mode. `time`: the time of their last
    change, s since 1970."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode, entry.mtime = len(data), modes.get(name, 0o600), time
            archive.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def read_release(path: Path) -> Release:
    """Read `balboa-swarm-ID.tar.gz`. Raises `LocalError` where the file is no release."""
    try:
        # As a whole, which compares the checksum at its end: an archive is read up to its last file only.
        with tarfile.open(fileobj=io.BytesIO(gzip.decompress(path.read_bytes()))) as archive:
            entries = {entry.name.partition("/")[2]: entry for entry in archive.getmembers() if entry.isfile()}
            files = {name: archive.extractfile(entry).read() for name, entry in entries.items()}  # type: ignore[union-attr]
    except (OSError, tarfile.TarError, EOFError, zlib.error) as error:
        why = getattr(error, "strerror", None) or error
        raise LocalError(f"{path}: no release can be read: {why}; swarm deploy without a release makes one") from None
    try:
        identity = files["ID"].decode().strip()
        machine, python = files["FOR"].decode().split()
        files["install"]
    except (KeyError, ValueError) as error:
        raise LocalError(f"{path}: not a release ({error}); swarm deploy without a release makes one") from None
    return Release(path, identity, machine, python, files, {name: entry.mode for name, entry in entries.items()})


async def ask_kind(ssh: Ssh, host: Host) -> tuple[str, str] | None:
    """Return processor and Python of the robot, for which a release has to be made; None where the robot has no Python
    of ours."""
    machine, *pythons = (await ssh.check(host, _WHAT)).split()
    return (machine, pythons[0]) if pythons else None


def fitting(releases: Sequence[Release], machine: str, pythons: list[str]) -> Release:
    """Return the release for a robot. Raises `HostError` that names what the robot would need."""
    for release in releases:
        if release.machine == machine and release.python in pythons:
            return release
    have = ", ".join(f"{release.machine} Python {release.python}" for release in releases)
    needs = f"{machine} Python {pythons[-1]}" if pythons else f"{machine} without any Python that we know"
    raise HostError(f"it is {needs}, the releases are for {have or 'none'}: swarm deploy without one makes what fits")


async def bring(ssh: Ssh, host: Host, release: Release, tell: ReportProgress) -> int:
    """Bring the release into the robot's folder, and return the number of bytes sent."""
    lacks = [
        name for name in (await ssh.check(host, _LACKS, feed=[release.sums])).splitlines() if name in release.files
    ]
    sent = len(release.sums)
    if lacks:
        data = pack({name: release.files[name] for name in lacks}, release.modes)
        sent += len(data)
        tell(f"sending {len(lacks)} of {len(release.files)} files, {len(data) / 1e6:.1f} MB")
        arrived = f"cd {FOLDER} && tar --extract --no-same-owner --file=- && sha256sum --check --quiet SUMS"
        done = await ssh.run(host, arrived, feed=[data])
        if done.code != 0:
            raise HostError(
                f"not all of it arrived: is its disk full? does another deploy run? ({last_words(done.err)})"
            )
    return sent


_WHAT = "uname -m; for v in 3.11 3.12 3.13 3.14; do command -v python$v >/dev/null && echo $v; done; true"

_INSTALL = f"""umask 077; own=$(mktemp -d) || exit 1; copy=; trap 'rm -rf "$own" "$copy"' EXIT
tar --extract --file=- --directory=$own || exit 1
umask 022; find .cache -maxdepth 1 -name 'balboa-swarm.??????' -mmin +60 -exec rm -rf {{}} +
copy=$(mktemp -d "$PWD/.cache/balboa-swarm.XXXXXX") && cd {FOLDER} &&
    cut -c67- $own/SUMS | xargs cp --link --parents --target-directory="$copy" && cd "$copy" &&
    sha256sum --check --quiet $own/SUMS >&2 ||
    {{ echo 'what was sent has changed: another deploy runs on this robot; give the command again' >&2; exit 1; }}
sudo -n ./install --name $robot """
"""A command for the robot. Configuration and key arrive as a tar archive, so no copy of them stays in a home folder.
What is installed is a folder of links to the files of this release, checked: another deploy may replace them meanwhile.
"""


def read_files(config: Config, key: Path | None) -> dict[str, bytes]:
    """Return the files that go with a release, by the option of `install`. Raises `LocalError` where one cannot be
    read, where the key is readable by others, or where the robots would not look for it in its place."""
    if key is not None:
        if config.mesh.key_file not in (None, Path(DEFAULT_KEY_FILE)):
            raise LocalError(
                f"{key} would become {DEFAULT_KEY_FILE} on the robots, and [mesh] key of {config.path} has them look "
                f"for {config.mesh.key_file}: remove that line, or copy the key to that place and leave --key out"
            )
        read_keys(key)
    try:
        files = {"config": config.path.read_bytes()}
        if key is not None:
            files["key"] = key.read_bytes()
    except OSError as error:
        raise LocalError(f"{error.filename} cannot be read: {error.strerror}") from None
    return files


async def install(
    ssh: Ssh, host: Host, releases: Sequence[Release], files: Mapping[str, bytes], tell: ReportProgress
) -> tuple[str, int]:
    """Bring and install the release that fits the robot. Return what `install` said last, and the bytes sent."""
    machine, *pythons = (await ssh.check(host, _WHAT)).split()
    release = fitting(releases, machine, pythons)
    sent = await bring(ssh, host, release, tell)
    tell("installing")
    data = pack({**files, "SUMS": release.sums}, {})
    options = " ".join(f"--{name} $own/{name}" for name in files)
    said = await ssh.check(host, f"robot={shlex.quote(host.robot)}; {_INSTALL}{options}", feed=[data])
    return said.strip().splitlines()[-1].removeprefix("install: "), sent + len(data)
