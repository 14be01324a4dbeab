"""Robots carry `swarm` and `services` only, and nothing in the folder where a user types takes the place of ours."""

import io
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import swarm
from laptop.fleet.release.release import robot_wheel
from swarm.onboard.command_line import CommandGroup, commands_of
from swarm.onboard.commands import SECTIONS

ROOT = Path(__file__).parents[2]

BLOCKED = """
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("sim", "laptop"):
            raise ModuleNotFoundError(f"robots have no {name}", name=name)
sys.meta_path.insert(0, Blocker())
"""


def run(program: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a program in a Python that has neither `sim` nor `laptop`."""
    command = [sys.executable, "-c", BLOCKED + program, *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)


def test_everything_that_a_robot_carries_is_imported_without_the_laptop_and_the_simulated_world() -> None:
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("swarm", "services")
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.stem not in ("__init__", "__main__")
    ]
    done = run("import importlib\nfor name in sys.argv[1:]: importlib.import_module(name)", *names)
    assert done.returncode == 0, done.stderr[-2000:]


def test_each_command_of_a_robot_is_there_without_the_laptop() -> None:
    commands = []
    for name, each in commands_of(SECTIONS).items():
        commands += [[name, sub] for sub in each.commands] if isinstance(each, CommandGroup) else [[name]]
    program = """
import json
from swarm.onboard import command_line, commands
for words in json.loads(sys.argv[1]):
    try:
        command_line.main(commands.SECTIONS, [*words, "--help"])
    except SystemExit as ended:
        if ended.code:
            raise
"""
    done = run(program, json.dumps(commands))
    assert done.returncode == 0, done.stderr[-2000:]
    told = {" ".join(words) for words in commands if f"swarm {' '.join(words)}" in done.stdout}
    assert told == {" ".join(words) for words in commands}


def test_the_robots_distribution_has_the_commands_of_a_robot_and_no_version_of_its_own() -> None:
    own = tomllib.loads((ROOT / "deploy/robot/pyproject.toml").read_text())
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert own["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == ["swarm", "services"]
    assert own["project"]["name"] == whole["project"]["name"]
    assert own["project"]["requires-python"] == whole["project"]["requires-python"]
    assert own["project"]["scripts"].keys() == whole["project"]["scripts"].keys()
    assert whole["tool"]["hatch"]["version"] == own["tool"]["hatch"]["version"] == {"path": "swarm/__init__.py"}
    for place in own["project"]["scripts"].values():
        module, _, name = place.partition(":")
        assert run(f"import importlib; getattr(importlib.import_module({module!r}), {name!r})").returncode == 0


def test_a_robots_wheel_holds_neither_the_simulated_world_nor_the_laptop() -> None:
    name, data = robot_wheel()
    assert name == f"balboa_swarm-{swarm.__version__}-py3-none-any.whl"
    names = zipfile.ZipFile(io.BytesIO(data)).namelist()
    assert {name.partition("/")[0] for name in names} == {
        "swarm", "services", f"balboa_swarm-{swarm.__version__}.dist-info",
    }  # fmt: skip
    assert not [name for name in names if "__pycache__" in name]


@pytest.mark.slow
@pytest.mark.parametrize("words", [("sim", "consensus", "--robots", "2", "--iterations", "3"), ("check", "mine.py")])
def test_files_of_the_user_take_no_place_of_our_modules(runtime: Path, words: tuple[str, ...]) -> None:
    """Whoever types `swarm` in a folder with a `sim.py` or a `laptop.py` runs our modules, and so do its processes."""
    place = runtime / "work"
    place.mkdir()
    for name in ("sim", "laptop", "services", "swarm", "msgpack", "json"):
        (place / f"{name}.py").write_text("raise SystemExit('this is the file of the user')\n")
    (place / "mine.py").write_text((ROOT / "examples/max_finder.py").read_text())
    swarm_program = Path(sys.executable).with_name("swarm")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    options = ["--run-dir", str(runtime / "run")] if words[0] == "sim" else []
    done = subprocess.run(
        [swarm_program, *words, *options],
        cwd=place,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert "file of the user" not in done.stdout + done.stderr
    if words[0] == "check":  # what an app would import on a robot is named
        assert done.returncode == 1, done.stdout + done.stderr
        assert f"{place / 'swarm.py'} has the name of a package of Balboa Swarm" in done.stdout
    else:
        assert done.returncode == 0, done.stdout + done.stderr
