"""`swarm new` and `swarm check`: what is written runs, and every kind of bad app is named with file and line."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest
from conftest import thinned

from services.apps import loader
from sim.rehearsal import check, examine, limits, new, rehearse, trends
from sim.scenario import imports
from swarm.app import settings
from swarm.errors import AppError, LocalError
from swarm.onboard.command_line import Command, parser_of

EXAMPLES = Path(__file__).parents[3] / "examples"

HEAD = "import math, random\nfrom swarm import SyncApp\nCOUNT = 0\nclass Bad(SyncApp):\n    value: float\n"
STEP = HEAD + "    def step(self, neighbours):\n        mean = math.fsum(n.value for n in neighbours)\n"
"""Seven lines: the eighth is the one to blame."""


def write(directory: Path, text: str, name: str = "bad.py") -> str:
    path = directory / name
    path.write_text(text)
    return str(path)


def findings(file: str, iterations: int = 60, graphs: tuple[str, ...] = ("line",)) -> list[dict]:
    """What one process finds out, here in this one."""
    task = examine.Task(loader.load(file), 6, iterations)
    found = [examine.describe(task)]
    found += [vars(one) for one in examine.examine(task) if one.graph in graphs]
    return json.loads(json.dumps(found))


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """One graph, little patience, and the alarms that the process of its own would have."""
    monkeypatch.setattr(examine, "GRAPHS", ("line",))
    monkeypatch.setattr(limits, "STEP_LIMIT", 0.3)
    for each in ("TIME_LIMIT", "WAIT_LIMIT"):  # tests of these two set them themselves
        monkeypatch.setattr(limits, each, 1e3)
    before = {number: signal.signal(number, limits.alarm) for number in limits.ALARMS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_an_app_that_took_no_step_has_no_step_time_and_no_table_of_graphs(tmp_path: Path, short: None) -> None:
    app, *graphs = findings(write(tmp_path, STEP + "        self.value = 1 / 0\n"))
    found = check.judge([app, *graphs], [])
    assert not found["ok"]
    assert "ZeroDivisionError" in check.text(found)
    assert "\nstep " not in check.text(found)
    assert "settles at" not in check.text(found)


def test_new_says_what_its_test_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for there, said in ((True, "; pytest "), (False, "; pip install pytest; pytest ")):
        known = {"pytest": ModuleSpec("pytest", None) if there else None}
        monkeypatch.setattr(new.importlib.util, "find_spec", known.get)
        parser = parser_of("new", Command("sim.rehearsal.new"))
        assert new.run(parser.parse_args([str(tmp_path / f"app_{there}.py".lower())])) == 0
        assert said in capsys.readouterr().out


@pytest.mark.parametrize("name", new.examples())
def test_new_copies_an_example_and_never_over_a_file(tmp_path: Path, name: str) -> None:
    made = new.copy(name, tmp_path)
    assert made == tmp_path / name
    source = new.EXAMPLES / name
    for file in [source] if source.is_file() else [each for each in source.iterdir() if each.is_file()]:
        assert (tmp_path / file.relative_to(new.EXAMPLES)).read_bytes() == file.read_bytes()
    with pytest.raises(LocalError, match="is there already; it is not written over"):
        new.copy(name, tmp_path)


@pytest.mark.parametrize("kind", ["periodic", "event"])
def test_a_new_app_names_the_page_that_lists_the_handlers(tmp_path: Path, kind: str) -> None:
    app = tmp_path / "mine.py"
    assert new.run(parser_of("new", Command("sim.rehearsal.new")).parse_args([str(app), "--kind", kind])) == 0
    (page,) = set(re.findall(r"docs/[\w/-]+\.md", app.read_text()))
    assert "| `on_button(button)` |" in (Path(__file__).parents[3] / page).read_text()


def test_an_example_that_does_not_exist_names_those_that_do(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match=r"no example 'findtarget'; there are .*find_target\.py, .*foxglove, .*mocap"):
        new.copy("findtarget", tmp_path)
    assert not list(tmp_path.iterdir())
    assert new.copy("find_target", tmp_path).name == "find_target.py"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--from", "mocap", "--kind", "event"], "--kind goes with FILE.py"),
        ([], "either FILE.py for an app, or --from NAME"),
        (["app.py", "--from", "mocap"], "either FILE.py for an app, or --from NAME"),
    ],
)
def test_new_makes_an_app_of_a_kind_or_copies_an_example(words: list[str], said: str) -> None:
    with pytest.raises(LocalError, match=said):
        new.run(parser_of("new", Command("sim.rehearsal.new")).parse_args(words))


BAD = {
    "raises": ("        self.value = 1 / 0\n", "ZeroDivisionError: division by zero", 8),
    "no number": ("        self.value = float('nan') * mean\n", "value: nan is not a finite number", 8),
    "a wrong type": ("        self.value = 'much'\n", "value: expected a number, got 'much'", 8),
    "nothing declared": ("        self.speed = 3.0\n", "Bad declares no 'speed'", 8),
    "hangs": (
        "        while True:\n            mean += 1.0\n",
        "it hangs: a step computed for more than 0.3 s",
        (8, 9),
    ),
    "is random": ("        self.value = random.random()\n", "the same step gave two results", 8),
    "counts its calls": (
        "        global COUNT\n        COUNT += 1\n        self.value += 1e-3 * COUNT\n",
        "the same step gave two results",
        10,
    ),
    "goes by the time": (
        "        self.value = self.robot.clock.now()\n",
        "the same step gave two results",
        8,
    ),
    "returns": ("        return mean\n", "it returned", 6),
    "gives nan": ("        self.value = mean\n        self.value = math.nan\n", "nan is not a finite number", 9),
    "overflows": ("        self.value = 10.0 ** (400 * (self.k + 1))\n", "OverflowError", 8),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_step_is_named_with_file_and_line(tmp_path: Path, short: None, kind: str) -> None:
    body, message, line = BAD[kind]
    file = write(tmp_path, STEP + body)
    found = check.judge(findings(file), findings(file))
    assert not found["ok"]
    (problem,) = found["problems"]
    assert message in problem
    (named,) = re.findall(rf"{file}, (?:from )?line (\d+)", problem)
    assert int(named) in ([line] if isinstance(line, int) else line), problem


@pytest.mark.parametrize(
    ("result", "clash"),
    [
        ("{'x': self.x - 1, 'far': 0.0}", "its 'x' is (-1.0, -1.0), and the shared state of that name is (0.0, 0.0)"),
        ("{'x': self.x[0]}", "its 'x' is 0.0, and the shared state of that name is (0.0, 0.0)"),
        ("{'best': 'r0'}", "its 'best' is 'r0', and the shared state of that name is 0"),
        ("{'x': self.x, 'best': self.best, 'part': self.part, 'far': 1.0}", None),
        ("{'x': list(self.x), 'far': np.float64(1.0)}", None),
    ],
)
def test_a_result_that_differs_from_the_state_of_its_name_is_named(
    tmp_path: Path, short: None, result: str, clash: str | None
) -> None:
    file = write(
        tmp_path,
        "import numpy as np\nfrom swarm import Array, SyncApp, float32\nclass Clash(SyncApp):\n    x: Array[2]\n"
        "    best: int\n    part: float32\n    def step(self, neighbours):\n        self.part = 0.1 * self.k\n"
        f"    def result(self):\n        return {result}\n",
    )
    fault = findings(file, iterations=3)[1]["fault"]
    assert f"{file}, from line 9 on: {clash}" in fault if clash else not fault, fault


def test_a_step_that_waits_is_named_too(tmp_path: Path, short: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "WAIT_LIMIT", 0.3)
    file = write(tmp_path, STEP + "        __import__('time').sleep(100)\n")
    found = check.judge(findings(file), findings(file))
    assert "it hangs: a step took more than 0.3 s" in found["problems"][0]
    assert f"{file}, line 8" in found["problems"][0]
    monkeypatch.setattr(examine, "GRAPHS", ("line", "loop"))
    graphs = [found["graph"] for found in findings(file, graphs=("line", "loop")) if "graph" in found]
    assert graphs == ["line"], "it would wait as long again"


WAITING = "import time\nfrom swarm import PeriodicApp\nclass Slow(PeriodicApp):\n    on: bool\n    period = 0.02\n"


@pytest.mark.parametrize("when", ["True", "self.robot.name == 'r2'"])
def test_a_step_that_waits_longer_than_its_period_is_named_with_both(tmp_path: Path, short: None, when: str) -> None:
    file = write(
        tmp_path, WAITING + f"    def step(self, neighbours):\n        if {when}:\n            time.sleep(0.05)\n"
    )
    found = check.judge(findings(file), findings(file))
    (problem,) = found["problems"]
    assert re.fullmatch(
        rf"a step waits longer than its period of 0\.02 s \(for [\d.]+ s\) \({re.escape(file)}, line 6\)", problem
    )


def test_a_step_that_waits_once_or_within_its_period_is_none_too_late(tmp_path: Path, short: None) -> None:
    once = "    def step(self, neighbours):\n        if self.k == 3:\n            time.sleep(0.05)\n"
    assert findings(write(tmp_path, WAITING + once))[1]["fault"] == ""
    always = "    def step(self, neighbours):\n        time.sleep(0.001)\n"
    assert findings(write(tmp_path, WAITING.replace("0.02", "1.0") + always))[1]["fault"] == ""


def test_a_step_that_computes_longer_than_its_period_does_not_wait(tmp_path: Path, short: None) -> None:
    body = "    def step(self, neighbours):\n        if self.k < 4:\n            sum(range(2_000_000))\n"
    assert findings(write(tmp_path, WAITING + body))[1]["fault"] == ""


@pytest.mark.parametrize(("kind", "waits_s"), [("SyncApp", 0.05), ("EventApp", 0.2)])
def test_what_waits_ends_the_rehearsal_and_is_not_said_to_compute(
    tmp_path: Path, short: None, monkeypatch: pytest.MonkeyPatch, kind: str, waits_s: float
) -> None:
    monkeypatch.setattr(limits, "WAIT_LIMIT", 1.0)
    monkeypatch.setattr(examine, "GRAPHS", ("line", "loop"))
    handler = "step(self, neighbours)" if kind == "SyncApp" else "on_button(self, button)"
    text = f"import time\nfrom swarm import {kind}\nclass Slow({kind}):\n    on: bool\n    def {handler}:\n"
    file = write(tmp_path, text + f"        time.sleep({waits_s})\n")
    found = findings(file, graphs=("line", "loop"))
    assert [one["graph"] for one in found[1:]] == ["line"], "it would wait as long again"
    (warning,) = found[1]["warnings"]
    assert re.match(r"graph line: broken off after 1 s by the clock: .* \(.* s of it waiting\); no other", warning)


def test_a_rehearsal_that_is_ended_from_outside_is_not_said_to_have_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(check, "PATIENCE", 0.2)
    file = write(tmp_path, "import time\ntime.sleep(100)\n")
    assert check.run(parser_of("check", Command("sim.rehearsal.check")).parse_args([file])) == 1
    told = capsys.readouterr().out
    assert "bad.py: the rehearsal was not over after 0.2 s and was ended: likely the app hangs" in told
    assert "code" not in told


@pytest.mark.parametrize("method", ["start", "result"])
@pytest.mark.parametrize("kind", ["SyncApp", "PeriodicApp"])
def test_a_start_or_a_result_that_hangs_is_named_too(tmp_path: Path, short: None, kind: str, method: str) -> None:
    text = f"from swarm import {kind}\nclass Bad({kind}):\n    value: float\n    def step(self, neighbours):\n"
    file = write(tmp_path, text + f"        pass\n    def {method}(self):\n        while True: pass\n")
    found = check.judge(findings(file), findings(file))
    assert "it hangs" in found["problems"][0]
    assert f"{file}, line 7" in found["problems"][0]


@pytest.mark.parametrize("kind", ["SyncApp", "PeriodicApp"])
def test_weights_that_hang_are_named_too(tmp_path: Path, short: None, kind: str) -> None:
    text = f"from swarm import {kind}\nclass Bad({kind}):\n    value: float\n    def step(self, neighbours):\n"
    file = write(tmp_path, text + "        pass\n    def neighbour_weights(self):\n        while True: pass\n")
    found = check.judge(findings(file), findings(file))
    assert "it hangs" in found["problems"][0]
    assert f"{file}, line 7" in found["problems"][0]


def test_an_app_that_is_slow_to_make_does_not_hang(
    tmp_path: Path, short: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "STEP_LIMIT", 0.5)
    text = "import time\nfrom swarm import SyncApp\nclass Slow(SyncApp):\n    value: float\n"
    text += "    def step(self, neighbours):\n"
    weigh = "        until = time.process_time() + 0.15\n        while time.process_time() < until: pass\n"
    weigh += "        return super().neighbour_weights()\n"
    file = write(tmp_path, text + "        pass\n    def neighbour_weights(self):\n" + weigh)
    assert not findings(file, iterations=3)[1]["fault"]


def test_robots_that_run_different_algorithms_are_named(short: None) -> None:
    task = examine.Task(loader.load("consensus"), 3, 3, [settings.parse("r1.algorithm=thesis")])
    (found,) = examine.examine(task)
    assert "r1 runs another algorithm than r0" in found.fault


def test_one_that_diverges_is_told_from_one_that_counts(tmp_path: Path, short: None) -> None:
    file = write(tmp_path, STEP + "        self.value += 0.3 * (self.value - mean)\n")
    found = check.judge(findings(file), findings(file))
    assert found["problems"] == [f"it diverges on graph line: the results grow without end ({file}, line 6)"]
    assert found["graphs"][0]["trend"]["grows"]
    file = write(tmp_path, STEP + "        self.value += 1e3\n", "counts.py")
    assert check.judge(findings(file), findings(file))["ok"]


def test_who_goes_by_the_order_of_neighbours_is_warned(tmp_path: Path, short: None) -> None:
    file = write(tmp_path, STEP + "        self.value = neighbours[0].value / 2\n")
    found = check.judge(findings(file), findings(file))
    assert found["ok"]
    (warning,) = found["warnings"]
    assert "depends on the order of the neighbours" in warning


def test_a_sum_of_floats_is_warned_of(tmp_path: Path, short: None) -> None:
    body = "        self.value = (mean + sum(n.value for n in neighbours)) / 3 / sum(1 for n in neighbours)\n"
    file = write(tmp_path, STEP + body)
    found = check.judge(findings(file), findings(file))
    assert found["ok"]
    assert found["warnings"] == [f"{file}, line 8: sum() rounds floats differently from Python 3.12 on; use math.fsum"]


def test_a_slow_step_is_warned_of(tmp_path: Path, short: None) -> None:
    file = write(tmp_path, STEP + "        self.value = math.fsum([mean * 1e-9] * 500_000)\n")
    one = findings(file, 5)
    found = check.judge(one, one)
    assert any("on a Pi Zero 2 W, more than 10 ms" in warning for warning in found["warnings"])


def test_two_processes_that_differ_are_a_problem() -> None:
    one = findings(str(EXAMPLES / "consensus.py"), 10)
    other = json.loads(json.dumps(one))
    other[1]["digests"][7] += 1
    found = check.judge(one, other)
    assert not found["ok"]
    assert "graph line, iteration 7: two processes came to different states" in found["problems"][0]


def test_a_bad_handler_is_named(tmp_path: Path, short: None) -> None:
    text = "from swarm import PeriodicApp\nclass Bad(PeriodicApp):\n    value: float\n    def step(self, neighbours):\n"
    file = write(tmp_path, text + "        if self.k == 3:\n            self.value = 1 / 0\n")
    found = check.judge(findings(file), findings(file))
    assert f"{file}, line 6: ZeroDivisionError" in found["problems"][0]
    text = "from swarm import EventApp\nclass Bad(EventApp):\n    def on_button(self, button):\n"
    text += "        while True:\n            pass\n"
    file = write(tmp_path, text, "buttons.py")
    found = check.judge(findings(file), findings(file))
    assert "it hangs" in found["problems"][0]
    assert f"{file}, line " in found["problems"][0]


def test_a_fault_in_the_lockstep_of_a_channel_is_a_problem(tmp_path: Path, short: None) -> None:
    text = "from swarm import PeriodicApp, SyncApp, channel\nclass Mean(SyncApp):\n    v: float\n"
    text += "    def step(self, neighbours):\n        self.v = 1 / (self.k - 3)\n"
    text += "class Outer(PeriodicApp):\n    x: float\n    mean = channel(Mean)\n    def step(self, neighbours):\n"
    file = write(tmp_path, text + "        self.x = self.mean.v\n")
    found = check.judge(findings(file), findings(file))
    assert re.search(f"channel mean: Mean on .*{file}, line 5: ZeroDivisionError", found["problems"][0])


PERIODIC = "from swarm import PeriodicApp\nclass Mine(PeriodicApp):\n    on: bool\n    period = 0.2\n"


@pytest.mark.parametrize(
    "start", ["pass", "self.robot.leds(red=True)", "self.robot.after(0.1, 'x')", "self.robot.pose"]
)
def test_a_periodic_app_gets_all_its_steps_whatever_it_uses(tmp_path: Path, short: None, start: str) -> None:
    text = PERIODIC + f"    def start(self):\n        {start}\n    def step(self, neighbours):\n"
    file = write(tmp_path, text + "        self.on = not self.on\n        self.robot.leds(green=self.on)\n")
    one = findings(file)
    found = check.judge(one, one)
    assert (found["graphs"][0]["seconds"], found["graphs"][0]["iterations"]) == (20.0, 100)
    poses = "yes" if "pose" in start else "not asked for"
    assert f"ran         20 s, 100 steps, poses: {poses}, ranges: not asked for" in check.text(found)


def test_the_last_of_all_steps_is_rehearsed(tmp_path: Path, short: None) -> None:
    body = "    def step(self, neighbours):\n        self.robot.leds(green=True)\n        assert self.k < 99\n"
    file = write(tmp_path, PERIODIC + body)
    assert f"step 99: {file}, line 7: AssertionError" in check.judge(findings(file), [])["problems"][0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["SyncApp", "PeriodicApp"])
def test_poses_and_ranges_come_in_the_rehearsal_of_every_kind(tmp_path: Path, short: None, kind: str) -> None:
    text = f"from swarm import {kind}\nclass Mine({kind}):\n    x: float = 0.0\n    def step(self, neighbours):\n"
    text += "        pose, ranges = self.robot.pose, self.robot.ranges\n        self.robot.drive(0.1, 0.0)\n"
    text += "        self.x = 0.0 if pose is None or not ranges else round(pose.x, 1)\n"
    file = write(tmp_path, text)
    found = check.judge(findings(file), findings(file))
    assert found["problems"] == []
    assert "poses: yes, ranges: yes" in check.text(found)
    swarm = rehearse(file, robots=3)
    swarm.run(10)
    assert swarm.result("r2")["x"] != 0.0 if kind == "SyncApp" else swarm.units["r2"].result()["x"] != 0.0


def test_an_app_that_is_given_measurements_has_had_ranges(tmp_path: Path, short: None) -> None:
    file = write(
        tmp_path,
        "from swarm import SyncApp\nclass M(SyncApp):\n    x: float\n    measured = True\n"
        "    def step(self, neighbours):\n        self.x = self.robot.measurement.distance\n",
    )
    assert findings(file, iterations=3)[1]["ranges"] == "yes"


def test_what_robots_cannot_import_is_warned_of(tmp_path: Path, short: None) -> None:
    (tmp_path / "mine.py").write_text("")
    file = write(
        tmp_path, "import yaml, json\nfrom mine import *\n" + STEP.replace("import math", "import msgpack, math")
    )
    found = check.judge(findings(file, 5), findings(file, 5))
    assert found["warnings"] == [
        f"{file}, line 1: import of yaml: robots lack it, if [robot] packages of swarm.toml does not name it",
    ]


def test_what_robots_carry_is_what_their_packages_bring() -> None:
    lock = Path(__file__).parents[3] / "requirements-robot.lock"
    packages = {line.partition("==")[0].replace("-", "_") for line in lock.read_text().splitlines() if "==" in line}
    modules = {"pyserial": "serial"}
    assert imports.ROBOT_MODULES - {"zenoh", "swarm", "services"} == {modules.get(name, name) for name in packages}


def test_an_app_too_slow_for_its_rehearsal_is_not_said_to_have_run_it(
    tmp_path: Path, short: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "TIME_LIMIT", 0.05)
    file = write(tmp_path, PERIODIC + "    def step(self, neighbours):\n        sum(range(20000))\n")
    found = check.judge(findings(file), [])
    assert found["graphs"][0]["seconds"] < 20.0
    assert "graph line: broken off after 0.05 s of computing" in found["warnings"][0]


def test_good_apps_are_told_what_they_are(short: None) -> None:
    file = str(EXAMPLES / "consensus.py")
    found = check.judge(findings(file, 300), findings(file, 300))
    assert found["ok"]
    assert (found["kind"], found["bytes"], found["bytes_on_air"]) == ("sync", 8, 26)
    trend = found["graphs"][0]["trend"]
    assert trend["settles"] < 60
    assert trend["spread"] < 1e-9
    told = check.text(found)
    assert re.search(r"line +\d+ +\d+ \(value\) +\S+ \(value\)", told)
    assert "state       8 bytes (value float), 26 with the frame" in told
    assert "by an estimated factor of 10" in told


def test_the_report_names_the_result_that_moves_last_and_the_one_that_differs_most() -> None:
    histories = {
        name: [{"fast": 0.5**k, "vector": (1.0, float(k)), "own": 9.0 * robot} for k in range(40)]
        for robot, name in enumerate(("r0", "r1"))
    }
    found = trends.judge(histories)
    assert (found["settles"], found["slowest"], found["spread"], found["widest"]) == (None, "vector", 9.0, "own")


def test_a_test_of_convergence_that_returns_nothing_is_named(tmp_path: Path, short: None) -> None:
    body = "        pass\n    def converged(self):\n        self.value < 1\n"
    found = check.judge(findings(write(tmp_path, HEAD + "    def step(self, neighbours):\n" + body)), [])
    assert [it for it in found["warnings"] if "line 8: converged() returned None: the change of the state" in it]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "laptop.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)


def test_hash_order_is_found_by_the_command(tmp_path: Path) -> None:
    body = "        names = {n.name for n in neighbours} | {'a', 'b', 'c', 'd'}\n"
    body += "        self.value = float(sum(i * len(name) * ord(name[0]) for i, name in enumerate(names)))\n"
    done = run("check", write(tmp_path, STEP + body), "--iterations", "10", "--json")
    found = json.loads(done.stdout)
    assert done.returncode == 1
    assert not found["ok"]
    assert "two processes came to different states" in found["problems"][0]


def test_a_file_that_cannot_be_loaded_is_one_message(tmp_path: Path) -> None:
    done = run("check", write(tmp_path, "from swarm import SyncApp\nclass Bad(SyncApp:\n"))
    assert done.returncode == 1
    assert "bad.py, line 2: SyntaxError" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.parametrize("kind", thinned(["sync", "periodic", "event"]))
def test_a_new_app_passes_its_test_and_the_check(tmp_path: Path, kind: str, short: None) -> None:
    app, test = new.write(tmp_path / "my_first.py", kind)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test.name],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    found = check.judge(findings(str(app), 60), findings(str(app), 60))
    assert (found["problems"], found["warnings"]) == ([], [])
    assert max(map(len, app.read_text().splitlines())) <= 120
    with pytest.raises(LocalError, match="is there already; it is not written over"):
        new.write(app, kind)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("My.py", "a lower-case letter"),
        ("app.txt", "expected NAME.py"),
        ("consensus.py", "a built-in app of that name"),
        ("none/app.py", "there is no such folder"),
        ("class.py", "no keyword"),
        ("random.py", "in place of Python's random"),
        ("numpy.py", "in place of Python's numpy"),
    ],
)
def test_a_name_no_app_can_have_is_refused(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(LocalError, match=message):
        new.write(tmp_path / name, "sync")
    assert not list(tmp_path.iterdir())


def test_rehearse_takes_parameters_and_first_values() -> None:
    swarm = rehearse(
        "consensus", topology="thesis-d", parameters={"algorithm": "flood"}, values={"r5": {"value": 65.0}}
    )
    swarm.run(2)
    assert swarm.result("r3")["value"] == 65.0 / 6
    swarm = rehearse("localization", robots=3)
    swarm.run(60)
    assert swarm.result("r1")["x"] == pytest.approx(0.5)
    with pytest.raises(AppError, match="values: r9: expected values by robot, r0, r1; got one of 'value'"):
        rehearse("consensus", robots=2, values={"r9": {"value": 1.0}})
    with pytest.raises(AppError, match="no app 'nothing'"):
        rehearse("nothing")


def test_results_settle_spread_or_grow_as_their_trend_says() -> None:
    def of(*values: float) -> dict:
        return trends.judge({"r0": [{"x": value} for value in values]})

    assert of(*(0.5**k for k in range(50)))["settles"] == 7
    assert of(*(float(k) for k in range(50)))["settles"] is None
    assert of(*(2.0**k for k in range(50)))["grows"]
    assert not of(*(float(k**2) for k in range(50)))["grows"]
    # Robots of an app with events have results of different numbers: the end of each is its own last one.
    uneven = trends.judge({"r0": [{"x": 1.0}] * 4, "r1": [{"x": float(min(k, 9))} for k in range(40)]})
    assert (uneven["spread"], uneven["settles"]) == (8.0, 9)
    assert trends.judge({"r0": [{"name": "text"}] * 9}) == {"settles": None, "spread": None, "grows": False}


def test_an_app_that_prints_without_an_end_of_the_line_hides_no_fault(tmp_path: Path) -> None:
    file = tmp_path / "dots.py"
    file.write_text(
        "from swarm import SyncApp\nclass Dots(SyncApp):\n    value: float\n    def step(self, neighbours):\n"
        "        print('.', end='')\n        if self.k == 5:\n            raise ValueError('broken')\n"
    )
    command = [sys.executable, "-m", "laptop.cli", "check", str(file), "--robots", "3", "--iterations", "20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 1
    assert "ValueError: broken" in done.stdout


def test_an_app_that_ends_its_process_is_told_by_its_code_and_last_words(tmp_path: Path) -> None:
    file = tmp_path / "leaves.py"
    file.write_text(
        "import os\nfrom swarm import SyncApp\nclass Leaves(SyncApp):\n    value: float\n"
        "    def step(self, neighbours):\n        print('all is well', flush=True)\n        os._exit(3)\n"
    )
    command = [sys.executable, "-m", "laptop.cli", "check", str(file), "--robots", "3", "--iterations", "20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 1
    assert "the app's process ended with code 3; the last line it wrote: all is well" in done.stdout


def test_an_own_module_elsewhere_on_the_path_does_not_keep_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("elsewhere", "here"):
        (tmp_path / folder).mkdir()
    (tmp_path / "elsewhere" / "swerves.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path / "elsewhere")
    assert new.write(tmp_path / "here" / "swerves.py", "sync")[0].is_file()
