"""`swarm bundle`: what is downloaded is for the robots, whole, and what its index says."""

import io
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest

from laptop.cli.robots import bundle as command
from laptop.fleet.release import bundle
from swarm.errors import LocalError


def test_a_folder_without_a_bundle(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="no bundle"):
        bundle.repositories(tmp_path)


def test_a_bundle_needs_a_computer_with_apt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LocalError, match="there is no apt-get here: make the bundle on Debian"):
        bundle.download(tmp_path / "bundle", [], "arm64", ["a"])
    assert not (tmp_path / "bundle").exists()


APT = """#!/bin/sh
for word; do case $word in Dir::Cache=*) cache=${word#*=} ;; esac; done
case " $* " in
*' update '*) [ -z "$BROKEN" ] || echo "E: Failed to fetch http://x  Could not resolve 'x'" >&2 ;;
*' --simulate '*) echo "Inst a (1:2.0 Debian:12 [arm64])" ;;
*' show '*) cat $STANZA ;;
*) printf xyz > "$cache/archives/a_1%3a2.0_arm64.deb" ;;
esac
"""
SUM = "3608bca1e44ea6c4d268eb6db02260269892c0b42b86bbf1e77a6fa16c3c9282"
STANZA = f"Package: a\nVersion: 1:2.0\nFilename: pool/a.deb\nSize: 3\nSHA256: {SUM}\n"


@pytest.fixture
def apt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An apt that has one package; the file with its entry in the archive's index."""
    for name in ("apt-get", "apt-cache"):
        (tmp_path / name).write_text(APT)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    stanza = tmp_path / "stanza"
    stanza.write_text(STANZA)
    monkeypatch.setenv("STANZA", str(stanza))
    return stanza


def test_what_was_downloaded_is_what_the_index_says(tmp_path: Path, apt: Path) -> None:
    folder = tmp_path / "bundle/bookworm-arm64"
    assert bundle.download(folder, [], "arm64", ["a"]) == (1, 3)
    ((kind, repository),) = bundle.repositories(tmp_path / "bundle").items()
    (package,) = repository.packages.values()
    assert kind == ("bookworm", "arm64")
    assert (package.name, package.version, repository.data(package)) == ("a", "1:2.0", b"xyz")

    before = (folder / "Packages").read_text()
    apt.write_text(STANZA.replace(SUM[:4], "0000"))
    with pytest.raises(LocalError, match="does a proxy change it"):
        bundle.download(folder, [], "arm64", ["a"])
    assert (folder / "Packages").read_text() == before


def test_an_archive_that_cannot_be_reached(tmp_path: Path, apt: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BROKEN", "1")
    with pytest.raises(LocalError, match="Could not resolve 'x'"):
        bundle.download(tmp_path / "bundle", [], "arm64", ["a"])
    assert not (tmp_path / "bundle").exists()


def test_a_key_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "DEBIAN_KEYS", tmp_path)
    with pytest.raises(LocalError, match="a fresh robot has it as"):
        bundle.archives("bookworm", bundle.DEBIAN, tmp_path / "none")
    suites = [archive.suite for archive in bundle.archives("trixie", bundle.DEBIAN, None)]
    assert suites == ["trixie", "trixie-updates", "trixie-security"]


def release(path: Path, identity: str, python: str) -> None:
    files = {"ID": identity, "FOR": f"aarch64 {python}", "install": ""}
    with tarfile.open(path, "w:gz") as archive:
        for name, text in files.items():
            entry = tarfile.TarInfo(f"x/{name}")
            entry.size = len(text)
            archive.addfile(entry, io.BytesIO(text.encode()))


def test_a_new_release_takes_the_place_of_the_older_one_for_the_same_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release(tmp_path / "balboa-swarm-old.tar.gz", "old", "3.11")
    release(tmp_path / "balboa-swarm-other.tar.gz", "other", "3.13")
    release(tmp_path / "made.tar.gz", "new", "3.11")

    def build(folder: Path, machine: str, python: str, packages: list[str]) -> Path:
        assert (machine, python, packages) == ("aarch64", "3.11", ["numpy"])
        return (folder / "made.tar.gz").rename(folder / "balboa-swarm-new.tar.gz")

    monkeypatch.setattr(command, "build", build)
    command._release(tmp_path, "aarch64", "3.11", ["numpy"])
    assert sorted(path.name for path in tmp_path.glob("*.tar.gz")) == [
        "balboa-swarm-new.tar.gz",
        "balboa-swarm-other.tar.gz",
    ]


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.skipif(shutil.which("apt-get") is None or not bundle.DEBIAN_KEYS.exists(), reason="needs Debian's apt")
def test_packages_of_debian_for_the_robots_processor(tmp_path: Path) -> None:
    """From Debian's archive, signature checked, for arm64 on whatever this is."""
    sources = [bundle.Archive(bundle.DEBIAN, "bookworm", bundle.DEBIAN_KEYS)]
    bundle.download(tmp_path / "bookworm-arm64", sources, "arm64", ["rfkill"])
    repository = bundle.read_repository(tmp_path / "bookworm-arm64")
    names = {package.name for package in repository.packages.values()}
    assert names >= {"rfkill", "libc6", "libsmartcols1"}
    for package in repository.packages.values():
        repository.data(package)
        said = ["dpkg-deb", "--field", str(repository.folder / package.file), "Architecture"]
        assert subprocess.run(said, check=True, capture_output=True, text=True).stdout.strip() in ("arm64", "all")
