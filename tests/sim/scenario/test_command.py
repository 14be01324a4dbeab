"""The command in the folder of a recording repeats the run."""

import json
import shlex
from pathlib import Path

import pytest

from laptop.cli.runs import sim
from sim.scenario.command import COMMAND_FILE, command_of
from sim.scenario.options import parse
from swarm import SyncApp, simulate
from swarm.errors import AppError

APP = """
from swarm import SyncApp

class Mine(SyncApp):
    x: float
    def step(self, neighbours):
        self.x += 0.2 * sum(n.x - self.x for n in neighbours)
"""


class Halves(SyncApp):
    x: float

    def step(self, neighbours: object) -> None:
        self.x /= 2.0


def repeated(record: Path, again: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Repeat a run by the command in its folder; whether the recordings are the same."""
    monkeypatch.chdir(record)
    swarm, verb, *words = shlex.split((record / COMMAND_FILE).read_text())
    assert (swarm, verb) == ("swarm", "sim")
    words += ["--record", str(again)]
    files = sorted(path.name for path in record.iterdir())  # before Python puts the app's bytecode there
    assert sim.run_simulation(parse(words), words) == 0
    assert files == sorted(path.name for path in again.iterdir())
    return all((record / name).read_bytes() == (again / name).read_bytes() for name in files)


def test_a_run_is_repeated_from_the_folder_of_its_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine.py").write_text(APP)
    monkeypatch.chdir(tmp_path)
    words = ["elsewhere/mine.py", "--virtual", "--robots=4", "--jitter", "10ms", "--cut=r0-r1@0.1s,0.2s", "--seed=7"]
    words += ["--set", "diverges_above=1e9", "--set", "r1.x=5", "--iterations", "30", "--json", "--record", "run"]
    assert sim.run_simulation(parse(words), words) == 0
    assert repeated(tmp_path / "run", tmp_path / "again", monkeypatch)


@pytest.mark.parametrize("words", [["--json"], ["--json", "--plot", "run.png"]])
def test_with_json_the_output_is_one_object_whatever_the_app_prints(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("talks.py").write_text(f"print('imported')\n{APP}        print('a step')\n")
    words = ["talks.py", "--virtual", "--iterations", "3", *words]
    assert sim.run_simulation(parse(words), words) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["iterations"] == 3
    assert "imported" in said.err
    assert "a step" in said.err


def test_a_command_that_is_refused_leaves_the_folder_of_its_recording_free(tmp_path: Path) -> None:
    words = ["consensus", "--virtual", "--set", "valeu=3", "--record", str(tmp_path / "run")]
    with pytest.raises(AppError, match="unknown parameter 'valeu'"):
        sim.run_simulation(parse(words), words)
    words[3] = "value=3"
    assert sim.run_simulation(parse(words), words) == 0


def test_a_run_of_simulate_is_repeated_from_where_it_was_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = simulate(
        "consensus", robots=3, topology="loop", values={"value": [1.0, 2.0, 4.0]}, iterations=10, jitter=0.01
    )
    run.save(tmp_path / "kept")
    assert (tmp_path / "kept" / COMMAND_FILE).is_file()
    run = simulate(Halves, robots=2, values={"x": [1.0, 2.0]}, iterations=3)
    assert (run.path / COMMAND_FILE).read_text().startswith("swarm sim halves.py --latency=0.03 --robots=2 ")
    assert "class Halves" in (run.path / "halves.py").read_text()


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["consensus", "--plot=a.png", "--record", "r", "--view", "--speed", "max"], "consensus"),
        (["/tmp/my app.py", "--set=x=1 2"], "'my app.py' '--set=x=1 2'"),
        (["goto", "--config", "../lab.toml", "--seed=3"], "goto --config=swarm.toml --seed=3"),
        (["goto", "--config=lab.toml"], "goto --config=swarm.toml"),
    ],
)
def test_results_are_left_out_and_copies_are_named(words: list[str], command: str) -> None:
    assert command_of(words) == f"swarm sim {command}"
