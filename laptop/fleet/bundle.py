"""A bundle: what robots without internet need, in a folder of the laptop. `swarm bundle` makes it.

FOLDER/bookworm-arm64/Packages      an index as apt reads it, with sizes and SHA-256 of
FOLDER/bookworm-arm64/*.deb         Debian packages with all that they depend on
FOLDER/balboa-swarm-*.tar.gz        releases (deploy/release), one for each Python
"""

import hashlib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from swarm.errors import LocalError
from swarm.frozen import frozen


@frozen
class Package:
    """One file of a repository."""

    name: str
    version: str
    file: str
    size: int
    sha256: str


@frozen
class Repository:
    """The packages for one Debian and architecture."""

    folder: Path
    index: str
    packages: Mapping[tuple[str, str], Package]
    """By name and version."""

    def data(self, package: Package) -> bytes:
        """A package's file, checked; raises `LocalError`."""
        path = self.folder / package.file
        try:
            data = path.read_bytes()
        except OSError as error:
            raise LocalError(f"{path}: {error.strerror}; make the bundle anew: swarm bundle") from None
        if len(data) != package.size or hashlib.sha256(data).hexdigest() != package.sha256:
            raise LocalError(f"{path}: is not what the index says; make the bundle anew: swarm bundle")
        return data


def read_repository(folder: Path) -> Repository:
    """Read the index of a folder; raises `LocalError` where it is none."""
    try:
        index = (folder / "Packages").read_text()
    except OSError as error:
        raise LocalError(f"{folder / 'Packages'}: {error.strerror}; make the bundle anew: swarm bundle") from None
    return Repository(folder, index, {(each.name, each.version): each for each in entries(index)})


def repositories(folder: Path) -> dict[tuple[str, str], Repository]:
    """The repositories of a bundle by Debian and architecture; raises `LocalError` where there are none."""
    found = {}
    for path in sorted(folder.glob("*/Packages")):
        suite, _, architecture = path.parent.name.partition("-")
        found[suite, architecture] = read_repository(path.parent)
    if not found:
        raise LocalError(f"{folder}: no bundle (swarm bundle {folder} makes one)")
    return found


def fields(stanza: str) -> dict[str, str]:
    """The fields of a stanza of Debian's control files; lines that continue a field are left out."""
    lines = (line.partition(":") for line in stanza.splitlines() if line[:1] not in (" ", "\t", "#", ""))
    return {name: value.strip() for name, colon, value in lines if colon}


def stanzas(index: str) -> list[str]:
    """The stanzas of an index."""
    return [stanza for stanza in re.split(r"\n[ \t]*\n", index.strip()) if stanza.strip()]


def entries(index: str) -> list[Package]:
    """The packages of an index; raises `LocalError` where a field that we need is missing or odd."""
    found = []
    for stanza in stanzas(index):
        field = fields(stanza)
        try:
            file = field["Filename"].removeprefix("./")
            package = Package(field["Package"], field["Version"], file, int(field["Size"]), field["SHA256"].lower())
        except (KeyError, ValueError) as error:
            raise LocalError(f"an index of packages without a proper {error}: swarm bundle makes a new one") from None
        if not re.fullmatch(r"[A-Za-z0-9][\w.+~%-]*\.deb", file) or not re.fullmatch(r"[0-9a-f]{64}", package.sha256):
            raise LocalError(f"an index of packages with an odd entry for {package.name}: swarm bundle makes a new one")
        found.append(package)
    return found


def index_of(all_stanzas: Iterable[str], files: Mapping[str, str]) -> str:
    """An index of those packages of `all_stanzas` whose SHA-256 is a key of `files`, at the file name it gives."""
    kept = {}
    for stanza in all_stanzas:
        digest = fields(stanza).get("SHA256", "").lower()
        if digest in files:
            lines = [line for line in stanza.splitlines() if not line.startswith("Filename:")]
            kept[digest] = "\n".join([*lines, f"Filename: ./{files[digest]}"]) + "\n"
    return "\n".join(kept[digest] for digest in sorted(kept))
