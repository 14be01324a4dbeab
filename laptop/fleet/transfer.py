"""A release to a robot: only the files that it lacks, checked when they are there.

The robot keeps the unpacked release in ~/.cache/balboa-swarm. It compares checksums; what differs or is missing is sent
as one tar stream and compared again, so what breaks in mid-transfer costs the rest of it and nothing else.
"""

import hashlib
import io
import tarfile
from collections.abc import Mapping
from pathlib import Path

from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host, HostError, Ssh, last_words
from swarm.errors import LocalError
from swarm.frozen import frozen

FOLDER = ".cache/balboa-swarm"
"""On the robot, below the home of the user who logs in."""

_LACKS = f"""set -e; umask 022; mkdir -p {FOLDER}; cd {FOLDER}; cat > SUMS
sha256sum --check --quiet SUMS 2>/dev/null | sed -n 's/: FAILED.*//p'
find . -type f ! -name SUMS | cut -c3- | while read -r name; do
    grep -qF "  $name" SUMS || rm -f "$name"
done"""
"""Prints the names of files that are not there as they should be, and removes those of other releases."""


@frozen
class Release:
    """A release as `deploy/release` makes it."""

    path: Path
    identity: str
    machine: str
    python: str
    files: dict[str, bytes]
    """Content by name."""
    modes: dict[str, int]

    @property
    def sums(self) -> bytes:
        """The input of `sha256sum --check`."""
        lines = (f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in sorted(self.files.items()))
        return "".join(lines).encode()


def pack(files: Mapping[str, bytes], modes: Mapping[str, int]) -> bytes:
    """A tar of these files; those without a mode are their owner's alone."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(data), modes.get(name, 0o600)
            archive.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def read_release(path: Path) -> Release:
    """Read `balboa-swarm-ID.tar.gz`; raises `LocalError` where it is none."""
    try:
        with tarfile.open(path) as archive:
            entries = {entry.name.partition("/")[2]: entry for entry in archive.getmembers() if entry.isfile()}
            files = {name: archive.extractfile(entry).read() for name, entry in entries.items()}  # type: ignore[union-attr]
    except (OSError, tarfile.TarError, EOFError) as error:
        raise LocalError(f"{path}: no release can be read: {error}; deploy/release makes one") from None
    try:
        identity = files["ID"].decode().strip()
        machine, python = files["FOR"].decode().split()
        files["install"]
    except (KeyError, ValueError) as error:
        raise LocalError(f"{path}: not a release ({error}); deploy/release makes one") from None
    return Release(path, identity, machine, python, files, {name: entry.mode for name, entry in entries.items()})


def fitting(releases: list[Release], machine: str, pythons: list[str]) -> Release:
    """The release for a robot; raises `HostError` that names what it would need."""
    for release in releases:
        if release.machine == machine and release.python in pythons:
            return release
    have = ", ".join(f"{release.machine} Python {release.python}" for release in releases)
    needs = f"{machine} Python {pythons[-1]}" if pythons else f"{machine} without any Python that we know"
    raise HostError(f"it is {needs}, the releases are for {have}: deploy/release --machine {machine} --python ...")


async def bring(ssh: Ssh, host: Host, release: Release, tell: ReportProgress) -> int:
    """Bring the release into the robot's folder; the number of bytes sent."""
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
            raise HostError(f"not all of it arrived: is its disk full? ({last_words(done.err)})")
    return sent
