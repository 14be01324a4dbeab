"""A file of an author's that has the name of one of the platform's packages: one plain message."""

import subprocess
import sys
from pathlib import Path

import pytest

from services.apps import loader, sources
from sim.rehearsal import new
from swarm import packages
from swarm.errors import AppError, LocalError

APP = """from swarm import SyncApp


class Mine(SyncApp):
    value: float

    def step(self, neighbours):
        pass
"""


def run(folder: Path, name: str) -> str:
    """Import `name` from `swarm` in a script of this folder; what Python prints last."""
    script = folder / "use.py"
    script.write_text(f"from swarm import {name}\n")
    found = f"import runpy, sys; sys.path[:0] = {[str(folder), str(packages.HOME)]!r}"
    done = subprocess.run(
        [sys.executable, "-c", f"{found}; runpy.run_path({str(script)!r})"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


@pytest.mark.parametrize("file", ["sim.py", "laptop.py", "services/__init__.py"])
def test_a_script_beside_a_file_with_the_name_of_a_package_is_told_to_rename_it(tmp_path: Path, file: str) -> None:
    own = tmp_path / file
    own.parent.mkdir(exist_ok=True)
    own.write_text("mine = 1\n")
    named = own.parent if own.name == "__init__.py" else own
    assert run(tmp_path, "simulate") == f"ImportError: {packages.rename(named)}"
    assert run(tmp_path, "SyncApp") == ""


def test_a_folder_without_python_hides_nothing(tmp_path: Path) -> None:
    (tmp_path / "services").mkdir()
    assert run(tmp_path, "simulate") == ""


@pytest.mark.parametrize("helper", packages.NAMES)
def test_an_app_whose_helper_has_the_name_of_a_package_is_told_to_rename_it(tmp_path: Path, helper: str) -> None:
    (tmp_path / "mine.py").write_text(f"import {helper}\n{APP}")
    (tmp_path / f"{helper}.py").write_text("gain = 1\n")
    with pytest.raises(AppError) as error:
        loader.load(str(tmp_path / "mine.py"))
    assert str(error.value) == packages.rename(tmp_path / f"{helper}.py")


def test_an_app_with_the_name_of_a_package_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sim.py").write_text(APP)
    with pytest.raises(AppError, match="rename the file"):
        loader.load(str(tmp_path / "sim.py"))
    with pytest.raises(LocalError, match="take another one"):
        new.write(tmp_path / "laptop.py", "sync")


def test_an_app_in_the_first_folder_of_a_checkout_does_not_consist_of_the_platform() -> None:
    assert sources.beside(packages.HOME, "swarm") == []
    assert sources.beside(packages.HOME / "swarm", "app") != []
