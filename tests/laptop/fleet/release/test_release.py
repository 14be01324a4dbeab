"""A release: made of what runs here, with the packages that robots are to have; equal sources give equal bytes."""

import functools
import hashlib
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from fake_robots import FakeRobots, Run
from needs import needs_ssh

from laptop.cli.robots import deploy
from laptop.fleet.release import release
from laptop.fleet.release.install import read_release
from laptop.fleet.release.release import build
from swarm.errors import LocalError

pytest_plugins = ["fleet_fixtures"]

PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"


def add_package(folder: Path, name: str, version: str = "1.0", needs: str = "") -> str:
    """Put a package into a folder where pip finds it; returns its line of a lock."""
    info = f"{name}-{version}.dist-info"
    path = folder / f"{name}-{version}-py3-none-any.whl"
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.py", f"version = {version!r}\n")
        archive.writestr(f"{info}/METADATA", metadata + (f"Requires-Dist: {needs}\n" if needs else ""))
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return f"{name}=={version} --hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n"


@pytest.fixture
def lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A lock of one package, and a pip that has it, two that need each other, and no network."""
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "robot.lock"
    path.write_text(add_package(tmp_path, "base"))
    add_package(tmp_path, "base", "2.0")
    add_package(tmp_path, "arrays", needs="base>=1.0")
    return path


@pytest.mark.slow
def test_a_release_holds_the_locked_and_the_further_packages_and_pip_installs_them_by_their_hashes(
    tmp_path: Path, lock: Path
) -> None:
    made = read_release(build(tmp_path / "dist", "aarch64", PYTHON, ["arrays"], lock=lock))
    assert (made.machine, made.python) == ("aarch64", PYTHON)
    wheels = {name for name in made.files if name.startswith("wheels/")}
    own, _ = release.robot_wheel()
    assert wheels == {f"wheels/{own}", "wheels/base-1.0-py3-none-any.whl", "wheels/arrays-1.0-py3-none-any.whl"}
    assert made.modes["install"] == 0o755
    assert {"uninstall", "systemd/swarm.target", "ID"} <= made.files.keys()
    assert made.lacks(["arrays>=1.0", "Base"]) == []
    assert made.lacks(["arrays", "numpy==2.0"]) == ["numpy==2.0"]

    for name, data in made.files.items():
        path = tmp_path / "robot" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--target", str(tmp_path / "there")]
    links = ["--find-links", "wheels", "--require-hashes", "-r", "requirements-robot.lock"]
    subprocess.run([*pip, *links], cwd=tmp_path / "robot", check=True, timeout=240)
    subprocess.run([*pip, "--no-deps", f"wheels/{own}"], cwd=tmp_path / "robot", check=True, timeout=240)
    said = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(tmp_path / 'there')!r})\n"
         "import arrays, base, swarm, services; print(base.version, swarm.__file__)"],
        check=True, capture_output=True, text=True, timeout=240,
    )  # fmt: skip
    assert said.stdout.split() == ["1.0", str(tmp_path / "there/swarm/__init__.py")]


def test_equal_sources_and_packages_give_an_equal_release_and_the_second_one_needs_no_index(
    tmp_path: Path, lock: Path
) -> None:
    first = build(tmp_path / "first", "x86_64", PYTHON, ["arrays"], lock=lock)
    for path in tmp_path.glob("*.whl"):
        path.unlink()
    second = build(tmp_path / "second", "x86_64", PYTHON, ["arrays"], lock=lock)
    assert (first.name, first.read_bytes()) == (second.name, second.read_bytes())


def test_a_package_that_cannot_be_had_is_named_and_no_release_is_made(tmp_path: Path, lock: Path) -> None:
    with pytest.raises(LocalError, match=r"the robots' packages cannot be downloaded \(.*unheard_of.*\)"):
        build(tmp_path / "dist", "aarch64", PYTHON, ["unheard_of"], lock=lock)
    assert not (tmp_path / "dist").exists()
    assert list((tmp_path / "cache/balboa-swarm/wheels").iterdir()) == []


@needs_ssh
def test_deploy_without_a_release_makes_the_one_that_fits_each_robot_and_has_the_packages_of_the_config(
    robots: FakeRobots, run: Run, lock: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    home = robots.add("r0")
    python = home / "bin/python3.11"
    python.write_text("#!/bin/sh\n")
    python.chmod(0o755)
    robots.add("r1", up=False)
    robots.script("r0", "sudo", 'shift; echo "$@" >$HOME/installed; echo "install: $(cat ID) runs as r0"')
    robots.config.write_text(robots.config.read_text() + '[robot]\npackages = ["arrays"]\n')
    monkeypatch.setattr(deploy, "build", functools.partial(build, lock=lock))
    assert run("deploy") == 1
    said = capsys.readouterr().out
    assert " runs as r0 (" in said
    assert "r1" in said
    assert (home / "installed").read_text().startswith("./install --name r0 --config ")
    assert (home / ".cache/balboa-swarm/wheels/arrays-1.0-py3-none-any.whl").exists()
    assert (home / ".cache/balboa-swarm/FOR").read_text() == f"{os.uname().machine} 3.11\n"

    bare = build(robots.folder, os.uname().machine, "3.11", lock=lock)
    assert run("deploy", str(bare)) == 2
    assert "lacks arrays, which [robot] packages of" in capsys.readouterr().err
