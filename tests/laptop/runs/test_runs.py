"""Runs from Python: `simulate`, `load` and `sweep` as a script, a test or a notebook uses them."""

import asyncio
import io
import math
import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from runs_apps import Beside, Light, Mean, NeverStarts, Place, Raises

import swarm
from laptop.plotting import states
from services.apps import loader
from sim.virtual.run import run_virtually
from swarm import SyncApp, load, parameter, rehearse, simulate, sweep
from swarm.errors import AppError, ConfigError, LocalError, RecordingError
from swarm.recording import trajectory

STARTS = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_a_class_of_a_test_is_simulated_and_its_states_are_an_array_by_iteration_and_robot() -> None:
    run = simulate(Mean, robots=6, topology="loop", values={"x": STARTS}, iterations=50)
    assert run.robots == ("r0", "r1", "r2", "r3", "r4", "r5")
    assert run["x"].shape == run.times.shape == (51, 6)
    assert run["x"].dtype == np.float64
    assert run["x"][0].tolist() == STARTS
    assert np.abs(run["x"][50] - 2.5).max() < 1e-3
    assert run.times[0].min() == 0.0
    assert (np.diff(run.times, axis=0) > 0).all()
    assert run.columns == ("x",)
    assert run.iterations == 50
    assert run.messages is not None
    assert 600 <= run.messages <= 660  # one for each neighbour and iteration, and those at start and end
    assert not run.problems


def test_simulate_computes_what_swarm_sim_virtual_does_to_the_bit() -> None:
    run = simulate("consensus", robots=np.int64(6), topology="thesis-d", jitter=0.01, seed=3, iterations=40)
    words = "consensus --robots 6 --topology thesis-d --jitter 0.01 --seed 3 --iterations 40"
    _, outcome = run_virtually(*words.split(), rows=True)
    for place, path in enumerate(outcome.trajectories.values()):
        assert [path.value(k, "value") for k in range(41)] == run["value"][:, place].tolist()


def test_a_saved_run_is_loaded_as_the_same_arrays_and_is_never_written_over(tmp_path: Path) -> None:
    run = simulate(Mean, robots=3, values={"x": {"r1": 4.0}}, iterations=10)
    run.save(tmp_path / "kept")
    again = load(tmp_path / "kept")
    assert repr(again) == repr(run)
    for one, other in ((run["x"], again["x"]), (run.times, again.times), (run.truth, again.truth)):
        assert np.array_equal(one, other)
    assert again.messages == run.messages
    with pytest.raises(LocalError, match="name a new folder"):
        run.save(tmp_path / "kept")
    with pytest.raises(RecordingError):
        load(tmp_path / "nothing")


def test_vectors_integers_truth_values_and_texts_have_arrays_of_their_own_kind() -> None:
    run = simulate(Place, robots=2, values={"q": [[1.0, 2.0], [3.0, 4.0]]}, iterations=4)
    assert run.columns == ("q", "count", "even", "far", "word")
    assert run["q"].shape == (5, 2, 2)
    assert run["q"][:, 1].tolist() == [[3.0 + k, 4.0] for k in range(5)]
    assert run["count"].dtype == np.int64
    assert run["count"][:, 0].tolist() == [0, 1, 2, 3, 4]
    assert run["even"].dtype == bool
    assert run["word"][:, 0].tolist() == ["odd", "odd", "even", "odd", "even"]
    assert run["far"][4].tolist() == [7.0, 11.0]


def test_an_unknown_column_is_an_error_that_names_the_columns() -> None:
    run = simulate(Mean, robots=2, iterations=2)
    with pytest.raises(LocalError, match=r"no column 'y'; there are: x$"):
        run["y"]
    with pytest.raises(LocalError, match="no column 'y'"):
        run.plot("y")
    with pytest.raises(LocalError, match=r"there are: x; a picture is written with path='mine.png'$"):
        run.plot("mine.png")
    assert "x" in run
    assert "y" not in run


def test_an_entry_of_a_vector_is_drawn_by_its_name() -> None:
    run = simulate(Place, robots=2, iterations=2)
    assert [axes.get_ylabel() for axes in run.plot("q[1]").axes] == ["q[1]", ""]
    with pytest.raises(LocalError, match=r"no column 'q\[2\]'; there are: q, "):
        run.plot("q[2]")
    with pytest.raises(LocalError, match="belong to a picture of kind states, not to mesh"):
        run.plot("q", kind="mesh")
    with pytest.raises(LocalError, match=r"links is recorded \(swarm sim --record and simulate\(..., devices=True\)"):
        run.plot(kind="mesh")


def test_of_a_part_of_the_run_the_iterations_of_that_time_are_drawn() -> None:
    run = simulate(Mean, robots=2, iterations=60)
    figure = Figure()
    states.states(figure, run.recording, between=(0.5, 1.0))
    there = np.flatnonzero(((run.times >= 0.5) & (run.times <= 1.0)).any(axis=1))
    assert figure.axes[0].get_xlim() == (there[0], there[-1])


def test_damage_of_a_recording_is_warned_of_and_a_problem_of_the_run(tmp_path: Path) -> None:
    simulate(Mean, robots=2, iterations=40).save(tmp_path)
    (file,) = tmp_path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.warns(UserWarning, match="it was cut off"):
        run = load(tmp_path)
    assert "it was cut off" in run.problems[-1]
    assert "it was cut off" in repr(run)


def test_files_of_two_runs_in_one_folder_are_named(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        simulate(Mean, robots=2, iterations=4, seed=seed).save(tmp_path / name)
    (file,) = (tmp_path / "b").glob("*.mcap")
    file.rename(tmp_path / "a" / "z.mcap")
    with pytest.warns(UserWarning, match=r"z\.mcap: it is of run [0-9a-f]+ of mean, other files are of run"):
        load(tmp_path / "a")


def test_a_run_that_never_began_can_be_printed_and_says_why_it_has_no_states() -> None:
    run = simulate(NeverStarts, robots=2, check=False)
    assert "without states, problems: " in repr(run)
    for look in (lambda: run.times, lambda: run.columns):
        with pytest.raises(RecordingError, match=r"no app's states are recorded; .*start\(\): .*ZeroDivisionError"):
            look()


def test_a_run_that_cannot_be_saved_says_where(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LocalError, match="file/run: the run cannot be saved there: Not a directory"):
        simulate(Mean, robots=2, iterations=2).save(tmp_path / "file" / "run")


@pytest.mark.parametrize("app", ["formation", "goto"])
def test_a_run_whose_devices_are_recorded_is_the_run_that_is_not(app: str) -> None:
    plain, recorded = (simulate(app, robots=3, seconds=8.0, devices=devices) for devices in (False, True))
    assert plain.truth is not None
    assert recorded.truth is not None
    assert np.array_equal(plain.truth, recorded.truth, equal_nan=True)


def test_an_apps_fault_is_raised_with_file_and_line_and_can_be_looked_at_instead() -> None:
    with pytest.raises(AppError, match=r"Raises on r\d, iteration 3: .*runs_apps.py, line \d+: ZeroDivisionError"):
        simulate(Raises, robots=2)
    run = simulate(Raises, robots=2, check=False)
    assert "ZeroDivisionError" in run.problems[0]
    assert run["x"].shape == (4, 2)


def test_a_run_that_has_not_converged_is_warned_of_and_has_its_values() -> None:
    with pytest.warns(UserWarning, match="simulate: not converged within 5 iterations"):
        run = simulate("consensus", robots=3, iterations=5, until="converged", progress=False)
    assert run["value"].shape == (6, 3)
    assert run.problems == ("not converged within 5 iterations",)
    table = sweep("consensus", over={"robots": [3]}, iterations=5, until="converged", progress=False)
    assert [row["problem"] for row in table.runs] == [""]


def test_faults_happen_and_a_robot_that_is_away_has_no_numbers() -> None:
    plain = simulate(Mean, robots=4, topology="loop", values={"x": STARTS[:4]}, iterations=60)
    cut = simulate(Mean, robots=4, topology="loop", values={"x": STARTS[:4]}, iterations=60,
                   faults=["cut r0-r1@0.5s,2s"])  # fmt: skip
    assert np.array_equal(plain["x"], cut["x"])
    assert cut.times[-1].max() > plain.times[-1].max() + 1.0
    away = simulate(Mean, robots=4, topology="loop", absent="drop", drop_after=1.0, seconds=4.0,
                    faults=["off r3@1s,100s"])  # fmt: skip
    assert np.isnan(away["x"][-3, 3])
    assert np.isnan(away.times[-3, 3])
    assert np.isfinite(away["x"][-3, :3]).all()


def test_the_truth_follows_a_robot_that_drives_and_a_target_that_moves() -> None:
    run = simulate("goto", robots=2, iterations=40, target_velocity=(0.1, 0.0))
    assert run.truth is not None
    assert run.target is not None
    assert run.truth.shape == (*run.times.shape, 3)
    assert np.hypot(*(run.truth[-1, 0, :2] - run.truth[0, 0, :2])) > 0.05
    late = run.times[:, 0] > 1.0
    speed = np.gradient(run.target[late, 0, 0], run.times[late, 0])
    assert np.allclose(speed, 0.1, atol=1e-6)


def test_periodic_apps_and_channels_are_runs_too() -> None:
    run = simulate(Light, robots=3, seconds=3.0, faults=["press r0.A@1s"])
    assert run["lit"][-1].any()
    channels = simulate(Beside, robots=3, seconds=2.0)
    assert np.abs(channels["mean.x"][20] - 1.0).max() < 0.2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robot": 3}, "no option 'robot'"),
        ({"values": {"y": 1.0}}, "unknown parameter 'y'; Mean has .*x"),
        ({"values": {"x": [1.0]}}, "one for each of 6 robots; got shape"),
        ({"values": {"x": {"r9": 1.0}}}, "x: expected values by robot, r0, .*; got one of 'r9'"),
        ({"values": {"x": object()}}, "x: expected numbers"),
        ({"values": {"gain": True}}, "gain: expected a finite number, got True"),
        ({"faults": ["burn r0@1s"]}, "no fault such as .* there are cut"),
        ({"faults": "cut r0-r1@1s,2s"}, "faults: expected a list of texts, got 'cut"),
        ({"faults": ["cut r0-r1"]}, "--cut: 'r0-r1' is not a cut"),
        ({"topology": "ring"}, "--topology ring"),
        ({"iterations": 3, "seconds": 2.0}, "not allowed with"),
        ({"seconds": 0}, "--seconds: '0': expected a time above 0, such as 30ms or 3s"),
        ({"values": [1.0]}, r'values: expected them by name, such as {"x": \[1.0, 2.0\]}, got \[1.0\]'),
        ({"faults": [1]}, r"faults: expected a list of texts, got \[1\]"),
        ({"faults": None}, "faults: expected a list of texts, got None"),
        ({"robots": "6"}, "robots: expected a whole number, got '6'"),
        ({"robots": 0}, "--robots: '0': expected a whole number from 1 to 100000"),
        ({"topology": np.ones((3, 3))}, r'numpy.savetxt\("graph.txt"'),
        ({"config": "swarm.toml", "robots": 4}, "--config names robots and topology itself"),
        ({"config": "swarm.toml", "topology": "loop"}, "--config names robots and topology itself"),
        ({"latency": "soon"}, "--latency: 'soon'"),
        ({"faults": ["off r3@200ms,1s"]}, 'has lost its state .*absent="drop" in a program'),
    ],
)
def test_a_wrong_argument_is_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises((AppError, ConfigError), match=message):
        simulate(Mean, **arguments)  # type: ignore[arg-type]
    with pytest.raises(AppError, match="expected the name or file of an app, or a class"):
        simulate(7)  # type: ignore[arg-type]


def test_a_notebooks_cell_under_a_running_event_loop_can_define_and_simulate_an_app() -> None:
    cell = """
from swarm import SyncApp, simulate
class CellApp(SyncApp):
    x: float
    def step(self, neighbours):
        self.x += 1.0 / (self.k - 5)
run = simulate(CellApp, robots=2, iterations=3)
"""
    notebook = types.ModuleType("__main__")

    async def execute(text: str) -> None:
        exec(compile(text, "/tmp/ipykernel_1/17.py", "exec"), vars(notebook))

    was = sys.modules["__main__"]
    sys.modules["__main__"] = notebook
    try:
        asyncio.run(execute(cell))
        assert vars(notebook)["run"].app == "cell_app"
        with pytest.raises(AppError, match=r"ipykernel_1/17.py, line 6: ZeroDivisionError"):
            asyncio.run(execute("simulate(CellApp, robots=2, iterations=9)"))
    finally:
        sys.modules["__main__"] = was


def test_without_pandas_a_table_is_refused_by_the_extras_name(monkeypatch: pytest.MonkeyPatch) -> None:
    run = simulate(Place, robots=2, iterations=2)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(LocalError, match=r"balboa-swarm\[notebook\]"):
        run.to_pandas()


def test_a_table_has_a_row_for_each_robot_and_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = types.ModuleType("pandas")
    pandas.DataFrame = lambda columns: columns  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    run = simulate(Place, robots=2, values={"q": [1.0, 2.0]}, iterations=2)
    table: dict[str, np.ndarray] = run.to_pandas()  # type: ignore[assignment]
    assert list(table) == ["iteration", "robot", "t", "q[0]", "q[1]", "count", "even", "far", "word"]
    assert table["iteration"].tolist() == [0, 0, 1, 1, 2, 2]
    assert table["robot"].tolist() == ["r0", "r1"] * 3
    assert table["q[0]"].tolist() == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]


def test_a_run_is_drawn_into_a_figure_and_a_file(tmp_path: Path) -> None:
    run = simulate(Place, robots=2, iterations=3)
    figure = run.plot("q", path=tmp_path / "run.png")
    assert len(figure.axes) == 4  # two parts of the vector, each over iterations and over time
    assert (tmp_path / "run.png").stat().st_size > 5000
    with pytest.raises(LocalError, match="no picture of kind 'pie'; there are: states"):
        run.plot(kind="pie")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "run.gif"}, "'run.gif': a picture is a file that ends in .png, .pdf, .svg"),
        ({"path": "away/run.png"}, "'away/run.png': there is no folder away"),
        ({"kind": "leds"}, "no LED has been switched in this recording"),
    ],
)
def test_a_picture_that_cannot_be_drawn_is_refused_with_the_words_of_the_commands(
    options: dict[str, str], message: str
) -> None:
    with pytest.raises(LocalError) as refused:
        simulate(Place, robots=1, iterations=1).plot(**options)  # type: ignore[arg-type]
    assert str(refused.value) == message


def test_a_sweep_is_a_table_of_all_combinations(tmp_path: Path) -> None:
    found = sweep(Mean, {"topology": ["line", "loop"], "gain": [1.0, 9.0]}, values={"x": STARTS}, seeds=2)
    assert [(row["topology"], row["gain"], row["runs"], row["failed"]) for row in found.rows] == [
        ("line", 1.0, 2, 0), ("line", 9.0, 2, 2), ("loop", 1.0, 2, 0), ("loop", 9.0, 2, 2),
    ]  # fmt: skip
    assert found.rows[2]["settled"] < found.rows[0]["settled"]
    assert len(found.runs) == 8
    assert "diverges" in found.runs[2]["problem"]
    assert "settled after" in str(found)
    found.plot(tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").stat().st_size > 5000


def test_a_sweep_refuses_what_no_run_can_be_made_of() -> None:
    with pytest.raises(ConfigError, match="jobs: a class cannot go to other processes"):
        sweep(Mean, {"gain": [1.0]}, jobs=2)
    with pytest.raises(ConfigError, match="jobs: expected a number of processes above zero, got 0"):
        sweep(Mean, {"gain": [1.0]}, jobs=0)
    with pytest.raises(ConfigError, match="a list is empty"):
        sweep(Mean, {"gain": []})
    for none in (0, -2, [], [1, -1], "3-5", 2.0):
        with pytest.raises(ConfigError, match=f"seeds: {re.escape(repr(none))}: expected a number of seeds above zero"):
            sweep(Mean, {"gain": [1.0]}, seeds=none)  # type: ignore[arg-type]
    for none in (-0.1, math.nan):
        with pytest.raises(ConfigError, match=f"within: expected a distance of 0 or more, got {none}"):
            sweep(Mean, {"gain": [1.0]}, within=none)
    with pytest.raises(ConfigError, match=r"over: expected lists by name, .* got \['line'\]"):
        sweep(Mean, ["line"])  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"over: gain: expected a list of values, got 0.5"):
        sweep(Mean, {"gain": 0.5})  # type: ignore[dict-item]
    for name in ("noise", "iterations"):
        with pytest.raises(
            ConfigError, match=f"over: {name} is an argument of all runs .* lists may be of robots, top"
        ):
            sweep(Mean, {name: [0.01, 0.02]})
    with pytest.raises(ConfigError, match="over: topology: expected a list of values, got 'line'"):
        sweep(Mean, {"topology": "line"})
    with pytest.raises(ConfigError, match="there is no option 'sped'"):
        sweep(Mean, {"gain": [1.0]}, sped=3)


class Lossy(Mean):
    """Has a parameter with the name of one of the radio."""

    loss: float = parameter(0.0, unit="1")


def test_a_sweep_is_over_the_radio_unless_the_app_has_such_a_parameter() -> None:
    found = sweep(Mean, {"latency": ["10ms", 0.03], "jitter": [0.0, 0.02]}, iterations=20, values={"x": STARTS})
    seconds = [run["seconds"] for run in found.runs]
    assert seconds[0] == pytest.approx(0.2, abs=0.03)
    assert seconds[0] < seconds[1]
    assert seconds[0] < seconds[2] < seconds[3]
    lost = sweep(Mean, {"loss": [0.0, 0.5]}, iterations=20, values={"x": STARTS}).runs
    assert lost[0]["seconds"] < lost[1]["seconds"]
    own = sweep(Lossy, {"loss": [0.0, 0.5]}, iterations=20, values={"x": STARTS}).runs
    assert own[0]["seconds"] == own[1]["seconds"]


@pytest.mark.parametrize(
    "fixed", [{"values": {"gain": 0.5}}, {"values": {"gain": [0.5, 1.0]}}, {"topology": "line"}, {"robots": 2}]
)
def test_a_sweep_over_values_refuses_another_value_for_all_its_runs(fixed: dict[str, object]) -> None:
    over = {"gain": [0.1, 0.9], "topology": ["loop"], "robots": [3]}
    with pytest.raises(ConfigError, match=r"over: \w+ has one value for all runs, too"):
        sweep(Mean, over, **fixed)  # type: ignore[arg-type]


def test_a_robot_says_that_it_carries_no_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "laptop"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [_Absent("laptop"), *sys.meta_path])
    with pytest.raises(ImportError, match=r"swarm.simulate is for a laptop"):
        swarm.simulate  # noqa: B018


class _Absent:
    """An import finder for which a package is not there."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(self, name: str, path: object, target: object = None) -> None:
        if name.partition(".")[0] == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=self.package)


def test_rehearse_takes_classes_and_lists_of_values() -> None:
    played = rehearse(Mean, robots=6, topology="loop", values={"x": STARTS})
    played.run(100)
    assert played.result("r3")["x"] == pytest.approx(2.5)


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("shown", "terminal"), [(True, True), (False, True), (True, False)])
def test_the_progress_of_a_run_is_drawn_on_a_terminal_alone_and_taken_away(
    shown: bool, terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = _Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("laptop.runs.progress.PATIENCE_S", 0.0)
    monkeypatch.setattr("laptop.runs.progress.EVERY_S", 0.0)
    simulate(Mean, robots=2, iterations=100, progress=shown)
    lines = stream.getvalue().split("\r")
    if not (shown and terminal):
        assert lines == [""]
        return
    shares = [int(line.rpartition("]")[2].strip(" %")) for line in lines[1:-2]]
    assert len(shares) >= 2
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] <= 100
    assert all(line.startswith("mean: 2 robots [") for line in lines[1:-2])
    assert not lines[-2].strip()


@pytest.mark.parametrize(("starts", "said"), [(1.0, "exactly 0 in all runs"), ([0.0, 1.0, 2.0, 4.0], "exactly 0")])
def test_errors_that_are_exactly_zero_are_drawn_and_said(starts: object, said: str) -> None:
    """On a full graph of four the mean is reached in one step and to the bit, on a line it is not."""
    found = sweep("consensus", {"topology": ["full", "line"]}, robots=4, values={"value": starts}, iterations=9)
    error = found.plot().axes[1]
    assert [text.get_text() for text in error.texts] == [said]
    drawn = [y for line in error.lines for y in line.get_ydata()]
    assert np.isfinite(drawn).all()
    assert error.get_yscale() == ("linear" if "all" in said else "log")


class Grids(SyncApp):
    x: float

    def step(self, neighbours: object) -> None:
        self.x += 1.0

    def result(self) -> dict[str, object]:  # type: ignore[override]
        return {"v": np.array([[self.x, 1.0, 2.0], [3.0, 4.0, 5.0]]), "w": [[1, 2], [3, 4]]}


def test_results_have_the_shapes_that_the_author_gives_them() -> None:
    run = simulate(Grids, robots=2, iterations=3)
    assert (run["v"].shape, run["w"].shape) == ((4, 2, 2, 3), (4, 2, 2, 2))
    assert run["v"][3, 1].tolist() == [[3.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    assert run["w"][0, 0].tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert "v[1,2]" in run.to_pandas()
    paths, (file,) = run.recording.trajectories(), run.path.glob("*.mcap")
    found = loader.of_class(Grids)
    _, outcome = run_virtually(found.name, "--robots", "2", "--iterations", "3", rows=True, app=found)
    assert trajectory.read(file).columns == paths["r0"].columns == outcome.trajectories["r0"].columns
