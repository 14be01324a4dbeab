"""Metrics of an app's own: `error(self, truth)` in results, report, sweep and picture, and nowhere on a real robot."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from laptop.cli.runs import plot, sweep_results
from laptop.plotting import style
from services.apps import loader
from services.apps.event_runner import EventRunner
from services.apps.runner import metrics_of
from sim.rehearsal import rehearse
from sim.sweep.measure import SweptRun, measure, summarize
from sim.sweep.plan import Job, SweepPoint, points_of
from sim.virtual.run import run_virtually
from swarm import sweep
from swarm.app.truth import RobotTruth, TruthWatch
from swarm.config import Config
from swarm.errors import LocalError
from swarm.messages import Target
from swarm.messages import Truth as TruePose
from swarm.messages.codec import encode

OWN_PLACE = """
import math
from swarm import PeriodicApp

class Own(PeriodicApp):
    x: float
    y: float
    gain: float = 0.2

    def step(self, neighbours):
        if (pose := self.robot.pose) is not None:
            self.x, self.y = pose.x, pose.y

    def error(self, truth):
        return math.dist((self.x, self.y), (truth.x, truth.y))

    def error_gain(self, truth):
        return abs(self.gain - truth.told["r0"].get("gain", 0.2))
"""

FINDS = """
from swarm import SyncApp

class Finds(SyncApp):
    x: float
    y: float
    measured = True

    def step(self, neighbours):
        self.x, self.y = 0.5, 1.1
"""


def write(place: Path, text: str) -> str:
    (place / "mine.py").write_text(text)
    return str(place / "mine.py")


def test_an_apps_own_errors_are_results_and_stand_in_the_report(tmp_path: Path) -> None:
    app = write(tmp_path, OWN_PLACE)
    arguments = ("--robots", "3", "--seconds", "6", "--set", "r0.gain=0.3")
    report, outcome = run_virtually(app, *arguments, "--record", str(tmp_path / "run"), rows=True)
    path = outcome.trajectories["r1"]
    assert path.columns[-2:] == ("result.error", "result.error_gain")
    assert path.value(1, "result.error") > 0.5
    assert report["error"] < report["error_most"] < 0.2
    assert (report["error_gain"], report["error_gain_most"]) == (pytest.approx(0.2 / 3), pytest.approx(0.1))
    plot.draw(tmp_path / "run", "mine", tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 5000


def test_an_app_that_measures_and_says_where_gets_the_error_of_the_target(tmp_path: Path) -> None:
    report, _ = run_virtually(write(tmp_path, FINDS), "--robots", "2", "--iterations", "5")
    assert report["error"] == pytest.approx(0.1)
    further = FINDS + "\n    def error_far(self, truth):\n        return 2.0\n"
    report, _ = run_virtually(write(tmp_path, further), "--robots", "2", "--iterations", "5")
    assert (report["error"], report["error_far"]) == (pytest.approx(0.1), 2.0)
    report, _ = run_virtually("goto", "--robots", "2", "--seconds", "2")  # x and y are its own place
    assert "error" not in report


def test_only_methods_are_metrics() -> None:
    assert metrics_of(loader.load("localization").algorithms["thesis"]) == ()
    assert metrics_of(loader.load("consensus").algorithms["metropolis"]) == ()


def test_the_truth_tells_first_values_of_the_class_where_nothing_else_is_given(tmp_path: Path) -> None:
    told = """
from swarm import Array, PeriodicApp, SyncApp, channel, parameter

class Inner(SyncApp):
    v: float

    def step(self, neighbours):
        pass

class Told(PeriodicApp):
    value: float
    x: Array[2] = (1.0, 2.0)
    own: float = parameter(0.25)
    inner = channel(Inner, v=4.0)

    def step(self, neighbours):
        pass

    def error(self, truth):
        r0, r1 = truth.told["r0"], truth.told["r1"]
        assert (r1["value"], r1["x"], r1["own"], r1["inner_v"]) == (0.0, (1.0, 2.0), 0.25, 4.0)
        return r0["value"] + r0["own"]
"""
    given = ("--set", "r0.value=3", "--set", "r0.own=0.5")
    report, _ = run_virtually(write(tmp_path, told), "--robots", "2", "--seconds", "1", *given)
    assert (report["problems"], report["error"]) == ([], 3.5)


def test_a_metric_that_raises_is_named_with_file_and_line(tmp_path: Path) -> None:
    app = write(tmp_path, OWN_PLACE.replace("return math.dist", "return 1 / 0 or math.dist"))
    report, _ = run_virtually(app, "--robots", "2", "--seconds", "2")
    assert f"error() at iteration 0: {app}, line 15: ZeroDivisionError" in report["problems"][0]
    app = write(tmp_path, OWN_PLACE.replace("return math.dist", "return str or math.dist"))
    report, _ = run_virtually(app, "--robots", "2", "--seconds", "2")
    where = f"error() at iteration 0: {app}, from line 14 on: "
    assert f"{where}expected a number, got <class 'str'>: return a float" in report["problems"][0]
    app = write(tmp_path, OWN_PLACE.replace("error(self, truth)", "error(self)"))
    report, _ = run_virtually(app, "--robots", "2", "--seconds", "2")
    assert f"{where}TypeError: " in report["problems"][0]
    assert "(declare `def error(self, truth)`)" in report["problems"][0]


def test_without_a_simulation_there_is_no_error(tmp_path: Path) -> None:
    found = loader.load(write(tmp_path, OWN_PLACE))
    swarm = rehearse(found.source, robots=2)
    runner = EventRunner(found.make(swarm.world.config, "r0"), found.source)
    assert math.isnan(runner.result()["error"])


def test_a_process_hears_the_truth_from_its_bus() -> None:
    swarm = rehearse("consensus", robots=2, values={"r1": {"value": 3.0}})
    config, kind = swarm.world.config, type(swarm.units["r1"].app)
    heard: dict[str, object] = {}

    class Bus:
        def subscribe(self, keys: list[str], callback: object) -> None:
            heard.update(dict.fromkeys(keys, callback))

    watch = TruthWatch(Bus(), "r1", "consensus", kind, config)  # type: ignore[arg-type]
    assert watch() is None
    take = heard["swarm/r1/sim/truth"]
    take("swarm/r1/sim/truth", b"nonsense")  # type: ignore[operator]
    assert watch() is None
    take("swarm/r1/sim/truth", encode(TruePose(1.0, 0.5, 0.25, 0.1, 0.0)))  # type: ignore[operator]
    take("swarm/r1/sim/target", encode(Target(1.0, 0.7, 0.8)))  # type: ignore[operator]
    assert isinstance(config, Config)
    found = watch()
    assert isinstance(found, RobotTruth)
    assert (found.x, found.y, found.target, found.told["r1"]["value"]) == (0.5, 0.25, (0.7, 0.8), 3.0)


def test_a_sweep_has_the_apps_error_and_says_so_where_there_is_nothing(tmp_path: Path) -> None:
    app = write(tmp_path, FINDS)
    points = points_of([("robots", ("2", "3"))])
    jobs = [Job(i, 1, (app, *each.arguments(), "--iterations", "5"), 0.01) for i, each in enumerate(points)]
    found = [measure(job) for job in jobs]
    assert [run.error for run in found] == [pytest.approx(0.1)] * 2
    sweep_results.draw("mine", points, found, tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").stat().st_size > 5000
    found = [run.__class__(run.point, run.seed, 5, None, None, 0.1, None, 0.1, "") for run in found]
    with pytest.raises(LocalError, match="nothing to draw: no result settled"):
        sweep_results.draw("mine", points, found, tmp_path / "none.png")


def test_the_picture_of_a_sweep_shows_where_runs_failed_or_did_not_settle(tmp_path: Path) -> None:
    points = [SweepPoint((("gain", text),)) for text in ("0.5", "1.0", "2.0")]
    runs = [
        SweptRun(0, 1, 9, None, 0.5, 0.1, None, 0.1, ""),
        SweptRun(1, 1, 9, 7, 0.5, 0.1, None, 0.1, ""),
        SweptRun(2, 1, 9, None, None, 0.1, None, 0.1, "diverges"),
    ]
    with style.figure(tmp_path / "sweep.png") as made:
        sweep_results.draw_on(made, "mine", points, runs)
    crosses = [
        [float(x) for line in axes.lines if line.get_marker() == "x" for x in line.get_xdata()] for axes in made.axes
    ]
    assert crosses == [[0.5, 2.0], [2.0]]  # iterations to settle, error


def test_a_sweep_has_each_metric_of_the_app(tmp_path: Path) -> None:
    app = write(tmp_path, OWN_PLACE)
    points = points_of([("robots", ("2", "3"))])
    jobs = [Job(i, 1, (app, *each.arguments(), "--seconds", "3"), 0.01) for i, each in enumerate(points)]
    found = [measure(job) for job in jobs]
    assert [dict(run.metrics) for run in found] == [{"error_gain": 0.0}] * 2
    assert "error_gain" in sweep_results.table(points, found)
    summed = summarize([found[0], replace(found[0], metrics={"error_gain": 2.0})])
    assert summed.metrics == {"error_gain": 1.0, "error_gain_most": 2.0}
    sweep_results.draw("own", points, found, tmp_path / "sweep.png")
    signed = [replace(run, metrics={"error_gain": 1e-3, "error_y": -0.1}) for run in found]
    with style.figure(tmp_path / "sweep.png") as made:
        sweep_results.draw_on(made, "own", points, signed)
    scales = {axes.get_ylabel(): axes.get_yscale() for axes in made.axes[1:]}
    assert scales == {"error": "log", "error_gain": "log", "error_y": "linear"}
    table = sweep(app, {"robots": [2]}, seconds=3)
    assert (table.rows[0]["error_gain"], table.rows[0]["error_gain_most"], table.runs[0]["error_gain"]) == (0, 0, 0)
