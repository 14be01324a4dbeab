"""A bundle: what robots without internet need, in a folder of the laptop. `swarm bundle` makes it.

FOLDER/bookworm-arm64/Packages      an index as apt reads it, with sizes and SHA-256 of
FOLDER/bookworm-arm64/*.deb         Debian packages with all that they depend on
FOLDER/balboa-swarm-*.tar.gz        releases (laptop.fleet.release.release), one for each Python

The packages are got by this computer's apt for another Debian and another processor. apt runs on folders of our own:
nothing of this computer's lists, packages or settings is read or changed, no root is needed. It checks the archive's
signature; the index of the bundle then holds each file's SHA-256.
"""

import hashlib
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from laptop.fleet.core.wish import FIRMWARE_PACKAGE, KERNEL_PACKAGE
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
    """The packages by name and version."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all packages in order."""
        return tuple(sorted({package.name for package in self.packages.values()}))

    def data(self, package: Package) -> bytes:
        """Return the file of a package after checking it. Raises `LocalError`."""
        path = self.folder / package.file
        try:
            data = path.read_bytes()
        except OSError as error:
            raise LocalError(f"{path}: {error.strerror}; make the bundle anew: swarm bundle") from None
        if len(data) != package.size or hashlib.sha256(data).hexdigest() != package.sha256:
            raise LocalError(f"{path}: is not what the index says; make the bundle anew: swarm bundle")
        return data


def read_repository(folder: Path) -> Repository:
    """Read the index of a folder. Raises `LocalError` where there is none."""
    try:
        index = (folder / "Packages").read_text()
    except OSError as error:
        raise LocalError(f"{folder / 'Packages'}: {error.strerror}; make the bundle anew: swarm bundle") from None
    return Repository(folder, index, {(each.name, each.version): each for each in entries(index)})


def repositories(folder: Path) -> dict[tuple[str, str], Repository]:
    """Return the repositories of a bundle by Debian and architecture. Raises `LocalError` where there are none."""
    found = {}
    for path in sorted(folder.glob("*/Packages")):
        suite, _, architecture = path.parent.name.partition("-")
        found[suite, architecture] = read_repository(path.parent)
    if not found:
        raise LocalError(f"{folder}: no bundle (swarm bundle {folder} makes one)")
    return found


def fields(stanza: str) -> dict[str, str]:
    """Return the fields of a stanza of Debian's control files; lines that continue a field are left out."""
    lines = (line.partition(":") for line in stanza.splitlines() if line[:1] not in (" ", "\t", "#", ""))
    return {name: value.strip() for name, colon, value in lines if colon}


def stanzas(index: str) -> list[str]:
    """Return the stanzas of an index."""
    return [stanza for stanza in re.split(r"\n[ \t]*\n", index.strip()) if stanza.strip()]


def entries(index: str) -> list[Package]:
    """Return the packages of an index. Raises `LocalError` where a field that we need is missing or odd."""
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
    """Return an index of those packages of `all_stanzas` whose SHA-256 is a key of `files`, with the file name it
    gives."""
    kept = {}
    for stanza in all_stanzas:
        digest = fields(stanza).get("SHA256", "").lower()
        if digest in files:
            lines = [line for line in stanza.splitlines() if not line.startswith("Filename:")]
            kept[digest] = "\n".join([*lines, f"Filename: ./{files[digest]}"]) + "\n"
    return "\n".join(kept[digest] for digest in sorted(kept))


DEBIAN = "http://deb.debian.org/debian"
DEBIAN_KEYS = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
PI = "http://archive.raspberrypi.com/debian"
PI_KEYS = tuple(Path("/usr/share/keyrings") / f"raspberrypi-archive-keyring.{end}" for end in ("pgp", "gpg"))
PI_PACKAGES = (FIRMWARE_PACKAGE, KERNEL_PACKAGE)
"""Packages of Raspberry Pi's own archive. Images of the last two years contain both."""


@frozen
class Archive:
    """A line of sources.list."""

    url: str
    suite: str
    keys: Path

    @property
    def line(self) -> str:
        """Return the line that apt reads."""
        return f"deb [signed-by={self.keys.resolve()}] {self.url} {self.suite} main"


def archives(suite: str, mirror: str, pi_keys: Path | None) -> tuple[Archive, ...]:
    """Return Debian's archive with its updates, and Raspberry Pi's where its key is known. Raises `LocalError`."""
    if not DEBIAN_KEYS.exists():
        raise LocalError(f"there is no {DEBIAN_KEYS}: sudo apt-get install debian-archive-keyring")
    if pi_keys is not None and not pi_keys.exists():
        raise LocalError(f"{pi_keys}: there is no such file; a fresh robot has it as {PI_KEYS[0]}")
    security = mirror.rstrip("/") + "-security"
    found = [Archive(mirror, name, DEBIAN_KEYS) for name in (suite, f"{suite}-updates")]
    found.append(Archive(security, f"{suite}-security", DEBIAN_KEYS))
    if pi_keys is not None:
        found.append(Archive(PI, suite, pi_keys))
    return tuple(found)


def download(folder: Path, sources: Sequence[Archive], architecture: str, packages: Sequence[str]) -> tuple[int, int]:
    """Fill `folder` with these packages, all they depend on, and an index. Return the number of packages, and their
    bytes.

    The folder is as it was, or whole. Raises `LocalError` where apt cannot do it.
    """
    with tempfile.TemporaryDirectory(prefix="swarm-bundle-") as name:
        apt = _Apt(Path(name), sources, architecture)
        apt.get("update")
        wanted = apt.get("--simulate", "install", *packages)
        install = re.findall(r"^Inst (\S+) (?:\[[^\]]*\] )?\((\S+) ", wanted, re.M)
        apt.get("--yes", "--download-only", "install", *packages)
        files = {}
        for path in (Path(name) / "cache/archives").glob("*.deb"):
            files[hashlib.sha256(path.read_bytes()).hexdigest()] = path
        shown = stanzas(apt.cache("show", *(f"{package}={version}" for package, version in install)))
        index = index_of(shown, {digest: path.name for digest, path in files.items()})
        found = entries(index)
        if {(each.name, each.version) for each in found} != set(install) or len(found) != len(files):
            raise LocalError("the download differs from what the archive's index says: does a proxy change it?")
        _replace(folder, index, list(files.values()))
        return len(found), sum(each.size for each in found)


def _replace(folder: Path, index: str, files: Sequence[Path]) -> None:
    """Move the files to a new folder, and that one to its place."""
    new = folder.with_name(folder.name + ".new")
    old = folder.with_name(folder.name + ".old")
    for path in (new, old):
        shutil.rmtree(path, ignore_errors=True)
    new.mkdir(parents=True)
    for path in files:
        shutil.copyfile(path, new / path.name)
    (new / "Packages").write_text(index)
    if folder.exists():
        folder.replace(old)
    new.replace(folder)
    shutil.rmtree(old, ignore_errors=True)


class _Apt:
    """apt with folders of its own below `work`, as if nothing at all were installed."""

    def __init__(self, work: Path, sources: Sequence[Archive], architecture: str) -> None:
        for path in ("state/lists/partial", "cache/archives/partial", "etc/preferences.d"):
            (work / path).mkdir(parents=True)
        (work / "status").touch()
        (work / "etc/sources.list").write_text("".join(source.line + "\n" for source in sources))
        settings = {
            "Dir::State": work / "state",
            "Dir::State::status": work / "status",
            "Dir::Cache": work / "cache",
            "Dir::Etc": work / "etc",
            "Dir::Etc::sourcelist": work / "etc/sources.list",
            "Dir::Etc::sourceparts": "/dev/null",
            "Dir::Etc::parts": "/dev/null",
            "APT::Architecture": architecture,
            "APT::Architectures": architecture,
            "APT::Sandbox::User": "",
            "Acquire::Languages": "none",
            "Acquire::Retries": "3",
            "Debug::NoLocking": "1",
        }
        self._options = [part for name, value in settings.items() for part in ("-o", f"{name}={value}")]

    def get(self, *words: str) -> str:
        """Run apt-get without recommended packages, and return its output."""
        return self._run("apt-get", "--no-install-recommends", *words)

    def cache(self, *words: str) -> str:
        """Run apt-cache, and return its output."""
        return self._run("apt-cache", *words)

    def _run(self, program: str, *words: str) -> str:
        try:
            done = subprocess.run(
                [program, "--quiet", *self._options, *words],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                check=False,
            )
        except FileNotFoundError:
            raise LocalError(f"there is no {program} here: make the bundle on Debian, Ubuntu or a robot") from None
        errors = [line for line in done.stderr.splitlines() if line.startswith(("E:", "W: GPG"))]
        if done.returncode != 0 or errors:  # `update` ends with 0 where an archive could not be reached
            said = "; ".join(errors[:2]) or done.stderr.strip()[-300:]
            raise LocalError(f"{program} {words[-1]}: {said or f'exit code {done.returncode}'}")
        return done.stdout
