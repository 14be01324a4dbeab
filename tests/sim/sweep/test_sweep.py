"""Sweeps: every combination with every seed, the same results on every engine; and the limit of a parameter."""

import argparse
import json
import re
import subprocess
import sys
from unittest import mock

import pytest
from conftest import thinned
from hypothesis import given
from hypothesis import strategies as st

from laptop.cli.runs import sweep as sweep_command
from laptop.cli.runs import sweep_results
from sim.sweep import engines
from sim.sweep.limit import search
from sim.sweep.measure import SweptRun, check, measure, settled, summarize
from sim.sweep.plan import Job, SweepPoint, jobs_of, points_of, seeds_of, setting_of, values_of
from swarm.errors import AppError, ConfigError, LocalError
from swarm.recording.trajectory import Trajectory


def test_a_sweep_reads_lists_of_values_and_seeds():
    assert values_of("6,12") == ("6", "12")
    assert values_of("[0,1],[1, 0]") == ("[0,1]", "[1, 0]")
    assert values_of("[[1,0],[0,1]],[[2,0],[0,2]]") == ("[[1,0],[0,1]]", "[[2,0],[0,2]]")
    assert setting_of("r2.value=3,4") == ("r2.value", ("3", "4"))
    assert seeds_of("3") == (1, 2, 3)
    assert seeds_of("5-7") == (5, 6, 7)


@pytest.mark.parametrize(
    ("convert", "text"),
    [
        (values_of, "6,,12"),
        (setting_of, "gain"),
        (setting_of, "=3"),
        (seeds_of, "0"),
        (seeds_of, "9-3"),
        (seeds_of, "x"),
    ],
)
def test_what_is_no_list_is_refused(convert, text):
    with pytest.raises(argparse.ArgumentTypeError):
        convert(text)


def test_every_combination_with_every_seed():
    points = points_of([("robots", ("3", "6")), ("algorithm", ("a", "b"))], [("loss", ("0.1",))])
    assert [dict(point.choices) for point in points] == [
        {"robots": robots, "algorithm": algorithm, "loss": "0.1"} for robots in ("3", "6") for algorithm in ("a", "b")
    ]
    assert points[0].arguments() == ["--robots=3", "--algorithm=a", "--set", "loss=0.1"]
    jobs = jobs_of("app", points, (1, 2), ["--jitter", "10ms"], 0.01)
    assert [(job.point, job.seed) for job in jobs] == [(point, seed) for point in range(4) for seed in (1, 2)]
    assert jobs[0].arguments[:2] == ("app", "--robots=3")
    assert jobs[0].arguments[-4:] == ("--seed", "1", "--jitter", "10ms")
    assert points_of([]) == [SweepPoint(())]
    with pytest.raises(ConfigError, match=r"loss: two lists have this name.*rename the parameter"):
        points_of([("loss", ("0.1",))], [("loss", ("1", "2"))])


def path_of(*values):
    times = {k: float(k) for k in range(len(values))}
    return Trajectory(("x", "result.x"), times, {k: (repr(v), repr(v)) for k, v in enumerate(values)})


def test_settled_is_when_the_last_result_of_all_has_come_to_stay():
    assert settled([path_of(*[1.0] * 20)], 0.01) == 0
    assert settled([path_of(5.0, 2.0, *[1.0] * 20), path_of(1.0, 5.0, 5.0, *[1.0] * 19)], 0.01) == 3
    assert settled([path_of(*map(float, range(20)))], 0.01) is None
    assert settled([path_of(float("nan"), float("nan"), *[1.0] * 20)], 0.01) == 2
    assert settled([path_of(1.0)], 0.01) is None
    assert settled([], 0.01) is None


@given(st.lists(st.floats(-9, 9), min_size=2, max_size=30), st.floats(0.0, 3.0))
def test_settled_says_what_it_means(values, within):
    found = settled([path_of(*values)], within)
    inside = [abs(value - values[-1]) <= within for value in values]
    if found is not None:
        assert all(inside[found:])
        assert found == 0 or not inside[found - 1]


def found_of(point, problem="", rounds=10, error=0.5):
    return SweptRun(point, 1, 100, rounds, error, 3.0, 0.03, 0.1, problem)


def test_runs_of_a_point_together():
    runs = [found_of(0), found_of(0, rounds=None), found_of(0, "r1 app boom", error=None), found_of(0, rounds=30)]
    one = summarize(runs)
    assert (one.runs, one.failed, one.unsettled) == (4, 1, 1)
    assert (one.settled, one.settled_most) == (20, 30)
    assert one.problem == "r1 app boom"
    text = sweep_results.table([SweepPoint((("gain", "0.1"),))], runs)
    assert "gain=0.1" in text
    assert "boom" in text


def test_a_run_gives_figures_and_a_wrong_one_says_so():
    run = measure(Job(3, 1, ("consensus", "--robots", "6", "--iterations", "90", "--seed", "1"), 0.01))
    assert (run.point, run.iterations, run.settled, run.problem) == (3, 90, 57, "")
    assert run.error < 0.01
    wrong = measure(Job(0, 1, ("consensus", "--set", "nonsense=3"), 0.01))
    assert "nonsense" in wrong.problem


UNSTABLE = """
from swarm import SyncApp, parameter


class Gain(SyncApp):
    value: float
    gain: float = parameter(0.1, low=0, high=10)

    def start(self):
        self.value = float(self.robot.swarm.index(self.robot.name) ** 2)

    def step(self, neighbours):
        self.value += self.gain * sum(n.value - self.value for n in neighbours)
"""


def test_a_robot_that_was_dropped_does_not_count():
    words = "consensus --robots 4 --topology loop --iterations 400 --absent drop --drop-after 2 --off r3@300ms,300s"
    found = measure(Job(0, 1, tuple(f"{words} --seed 1".split()), 0.01))
    assert found.problem == ""
    assert found.iterations == 400
    assert found.settled is not None


def test_the_limit_of_a_gain_is_found(tmp_path):
    """x' = x - g L x settles up to g = 2 / (largest eigenvalue of L): 2/3 on a line of three, 1 on one of two."""
    app = tmp_path / "gain.py"
    app.write_text(UNSTABLE)
    points = points_of([("robots", ("2", "3"))])
    done = []
    brackets = search(
        str(app), points, (1,), ["--iterations", "300", "--latency", "0ms"], 0.01, "gain", (0.1, 2.0),
        lambda jobs, each: [measure(job) for job in jobs], lambda: done.append(1),
    )  # fmt: skip
    for bracket, limit in zip(brackets, (1.0, 2 / 3), strict=True):
        assert bracket.good == pytest.approx(limit, rel=0.05)
        assert bracket.good < bracket.bad
    told = sweep_results.limits(points, "gain", brackets)
    assert "gain settles" in told
    assert re.search(r"fails robots=2 gain=[\d.]+: the results do not settle", told)


def test_a_limit_of_what_the_app_does_not_have_is_refused_and_one_that_is_not_found_says_why(tmp_path, capsys):
    app = tmp_path / "gain.py"
    app.write_text(UNSTABLE)
    command = ["sweep", str(app), "--robots", "2", "--iterations", "20", "--jobs", "1", "--limit"]
    with mock.patch("sys.argv", [*command, "nope=1,2"]), pytest.raises(AppError, match="unknown parameter 'nope'"):
        sweep_command.main()
    with mock.patch("sys.argv", [*command, "diverges_above=1e-6,1e-5"]):
        assert sweep_command.main() == 1
    assert re.search(r"fails robots=2 diverges_above=1e-06: .* is beyond diverges_above", capsys.readouterr().out)


def test_a_sweep_tells_of_faults_that_never_happened():
    points = points_of([("robots", ("3",))])
    words = ["--iterations", "5", "--latency", "10ms", "--off", "r1@5s,1s"]
    found = [measure(job) for job in jobs_of("consensus", points, (1, 2), words, 0.01)]
    assert re.search(r"never robots=3: --off r1@5s,1s: .*; in 2 of 2 runs", sweep_results.table(points, found))


def test_the_runs_of_a_sweep_have_no_recording():
    command = ["sweep", "consensus", "--record", "somewhere", "--seeds", "2"]
    with mock.patch("sys.argv", command), pytest.raises(ConfigError, match="--record: a sweep has many runs"):
        sweep_command.main()


@pytest.mark.parametrize("engine", thinned(engines.ENGINES))
def test_the_command_gives_what_one_process_gives(engine, tmp_path):
    if engine == "dask":
        pytest.importorskip("distributed", reason="Dask is not installed: pip install distributed")
    command = ["consensus", "--robots", "3,4", "--seeds", "2", "--iterations", "30", "--jitter", "5ms,9ms"]
    plot = tmp_path / "sweep.png"
    done = subprocess.run(
        [sys.executable, "-m", "laptop.cli.runs.sweep", *command, "--json", "--engine", engine, "--jobs", "2",
         "--plot", str(plot)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    told = json.loads(done.stdout)
    points = [(point["robots"], point["jitter"]) for point in told["points"]]
    assert points == [("3", "5ms"), ("3", "9ms"), ("4", "5ms"), ("4", "9ms")]
    assert plot.stat().st_size > 1000
    for index, point in enumerate(told["points"]):
        assert len(point["runs"]) == 2
        for run in point["runs"]:
            arguments = ("consensus", "--robots", point["robots"], "--seed", str(run["seed"]), "--iterations", "30")
            here = measure(Job(index, run["seed"], (*arguments, "--jitter", point["jitter"]), 0.01))
            assert (run["settled"], run["error"], run["seconds"]) == (here.settled, here.error, here.seconds)


def test_an_app_prints_nothing_between_the_results_of_a_sweep(tmp_path, capsys):
    (tmp_path / "talks.py").write_text(
        "from swarm import SyncApp\nprint('imported')\nclass Talks(SyncApp):\n    x: float\n"
        "    def step(self, neighbours):\n        print('a step')\n"
    )
    assert measure(Job(0, 1, (str(tmp_path / "talks.py"), "--iterations", "3"), 0.01)).problem == ""
    assert capsys.readouterr().out == ""


def test_a_wrong_command_is_refused_before_anything_runs():
    command = [sys.executable, "-m", "laptop.cli.runs.sweep", "consensus", "--robots", "3,none"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "none" in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["consenus", "--robots", "3,4"], "there is no app 'consenus'"),
        (["consensus", "--set", "nonsense=3,4"], "unknown parameter 'nonsense'"),
    ],
)
def test_what_no_run_can_be_made_of_is_one_message(words, said, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["sweep", *words])
    with pytest.raises(AppError, match=said):
        sweep_command.main()


def test_some_combinations_may_be_impossible():
    jobs = jobs_of("consensus", points_of([("robots", ("3", "6")), ("topology", ("thesis-d",))]), (1,), [], 0.01)
    check(jobs)
    with pytest.raises(ConfigError, match="thesis-d"):
        check(jobs[:1])


def figures(runs):
    """What of them does not depend on the machine."""
    return [(each.point, each.seed, each.settled, each.error, each.seconds, each.problem) for each in runs]


@pytest.mark.slow
def test_a_dask_cluster_that_runs_already_gives_the_same():
    """Of it only the address is known."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install distributed")
    jobs = jobs_of("consensus", points_of([("robots", ("3", "4"))]), (1, 2), ["--iterations", "20"], 0.01)
    expected = figures(map(measure, jobs))
    done = []
    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
        ) as cluster,
        engines.dask(2, cluster.scheduler_address) as run,
    ):
        assert figures(run(jobs, lambda: None)) == expected
        # Not from its memory: each sweep computes its own.
        assert figures(run(jobs, lambda: done.append(1))) == expected
    assert len(done) == len(jobs)


def test_without_dask_it_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask", None)
    with pytest.raises(LocalError, match=r"balboa-swarm\[dask\]"), engines.dask(1, None):
        pass
