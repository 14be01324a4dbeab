"""Event-driven and periodic apps as processes on real buses: barrier, restart, faults, parameters, devices."""

import json
import os
import queue
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from apps_rig import NAMES, Rig

from laptop.cli import main
from swarm.messages import (
    AppOutput,
    AppParameters,
    AppParametersSet,
    Buttons,
    SetAppParameters,
    SetDisplay,
    SetLeds,
    SetVelocity,
)
from swarm.messages.codec import decode, encode
from swarm.onboard import param as swarm_param

MakeRig = Callable[..., Rig]

COUNTER = """
from swarm import PeriodicApp, parameter
class Counter(PeriodicApp):
    count: int
    heard: int
    period = 0.05
    def step(self, neighbours):
        self.count += 1
        self.heard = sum(n.count for n in neighbours)
"""

HANDS = """
from swarm import EventApp, parameter
class Hands(EventApp):
    presses: int
    gain: float = parameter(0.5, unit="1/s", low=0, high=1)
    fixed: int = parameter(1, live=False)
    def on_button(self, button):
        self.presses += 1
        self.robot.leds(green=True)
        self.robot.drive(0.1, 0.0)
        self.robot.display(f"pressed {button}")
        self.robot.publish("pressed", button)
        if button == "b":
            raise ValueError("not that one")
        if button == "c":
            self.presses = "many"
    def on_parameter(self, name):
        self.robot.publish("changed", {name: getattr(self, name)})
"""


@pytest.fixture
def make_rig(runtime: Path) -> Iterator[MakeRig]:
    rigs: list[Rig] = []

    def make(name: str, text: str, names: tuple[str, ...] = NAMES, more: str = "") -> tuple[Rig, str]:
        rigs.append(Rig(runtime, names, more))
        app = runtime / f"{name}.py"
        app.write_text(text)
        return rigs[-1], str(app)

    yield make
    for rig in rigs:
        rig.__exit__()


class Watch:
    """What comes by on one robot's bus, decoded, in order."""

    def __init__(self, rig: Rig, robot: str, key: str, kind: type) -> None:
        self.found: queue.SimpleQueue[Any] = queue.SimpleQueue()
        rig.buses[robot].subscribe(key, lambda name, data: self.found.put(decode(kind, data, name)))

    def next(self) -> Any:
        return self.found.get(timeout=60)

    def until(self, condition: Callable[[Any], bool]) -> Any:
        while not condition(message := self.next()):
            pass
        return message


def test_a_periodic_app_starts_with_all_and_survives_a_kill(make_rig: MakeRig) -> None:
    rig, app = make_rig("counter", COUNTER, more="[apps.counter.robots.r2]\nperiod = 0.2\n")
    rig.start("r0", "apps", app)
    rig.start("r1", "apps", app)
    rig.until_waits("r0", "r2")
    rig.until_waits("r1", "r2")
    assert rig.progress["r0"].k == rig.progress["r1"].k == 0
    rig.start("r2", "apps", app)
    rig.until_k(5)
    assert rig.state["r0"].k > rig.state["r2"].k
    rig.kill("r1")
    before = {name: rig.state[name].k for name in ("r0", "r2")}
    rig.until(lambda: all(rig.state[name].k >= k + 3 for name, k in before.items()), "steps of the others")
    rig.state.pop("r1")
    rig.start("r1", "apps", app)
    rig.until_k(20, "r1")  # it waits for nobody: its neighbours are on their way
    rig.until(lambda: int(rig.state["r1"].state["heard"]) > rig.state["r2"].k, "news of both neighbours")
    rows = rig.rows("r0", "counter")
    assert sorted(rows) == list(range(len(rows)))
    assert {rig.stop(name) for name in NAMES} == {0}


def test_neighbours_follow_the_topology_in_force(make_rig: MakeRig) -> None:
    rig, app = make_rig("counter", COUNTER.replace("sum(n.count for n in neighbours)", "len(self.robot.neighbours)"))
    rig.start_all(app)
    rig.until(lambda: "r1" in rig.state and rig.state["r1"].state["heard"] == 2, "two neighbours")
    rig.set_topology(("r0", "r1"), ("r0", "r2"))
    rig.until(lambda: rig.state["r1"].state["heard"] == 1, "one neighbour")
    rig.until(lambda: rig.state["r0"].state["heard"] == 2, "two neighbours of r0")


def test_robots_with_another_version_are_named(make_rig: MakeRig) -> None:
    rig, app = make_rig("counter", COUNTER, ("r0", "r1"))
    other = rig.directory / "other"
    other.mkdir()
    (other / "counter.py").write_text(COUNTER.replace("self.count += 1", "self.count += 2"))
    rig.start("r0", "apps", app, "--run", "a1")
    rig.start("r1", "apps", str(other / "counter.py"), "--run", "a1")
    wanted = "r1 runs another version of this app: its state is not used"

    def named() -> bool:
        progress = rig.progress.get("r0")
        return progress is not None and (progress.phase, progress.reason) == ("waiting", wanted)

    rig.until(named, "naming r1")


def test_parameters_buttons_devices_and_faults(make_rig: MakeRig) -> None:
    rig, app = make_rig("hands", HANDS, ("r0",))
    bus = rig.buses["r0"]
    leds = Watch(rig, "r0", "swarm/r0/balancer/set/leds", SetLeds)
    drive = Watch(rig, "r0", "swarm/r0/balancer/set/velocity", SetVelocity)
    display = Watch(rig, "r0", "swarm/r0/balancer/set/display", SetDisplay)
    out = Watch(rig, "r0", "swarm/r0/app/hands/out/*", AppOutput)
    answers = Watch(rig, "r0", "swarm/r0/app/hands/parameters_set", AppParametersSet)
    told = Watch(rig, "r0", "swarm/r0/app/hands/parameters", AppParameters)
    rig.start("r0", "apps", app)
    rig.until_phase("running", "r0")

    bus.publish("swarm/r0/app/hands/set/parameters", SetAppParameters("t1", {"gain": 0.75}))
    assert answers.next().problem == ""
    told.until(lambda message: message.parameters["gain"].value == 0.75)
    assert out.next().values == {"gain": 0.75}
    bus.publish("swarm/r0/app/hands/set/parameters", SetAppParameters("t2", {"gain": 1.5}))
    wrong = "app hands on r0: gain: expected a finite number from 0 to 1 in 1/s, got 1.5"
    assert answers.next().problem == wrong
    bus.publish("swarm/r0/app/hands/set/parameters", SetAppParameters("t3", {"fixed": 2}))
    assert "fixed: cannot be changed while the app runs" in answers.next().problem
    found: queue.SimpleQueue[AppParameters] = queue.SimpleQueue()
    key = "swarm/r0/app/hands/parameters"
    bus.ask(key, lambda name, data: found.put(decode(AppParameters, data, name)), timeout_s=60.0)
    assert {name: p.value for name, p in found.get(timeout=60).parameters.items()} == {
        "weights": "metropolis", "gain": 0.75, "fixed": 1,
    }  # fmt: skip

    def press(**counts: int) -> None:
        bus.publish("swarm/r0/balancer/buttons", Buttons(0.0, False, False, False, *counts.values()))

    press(a=4, b=0, c=0)  # pressed before the app came
    press(a=5, b=0, c=0)
    assert out.next().values == {"value": "a"}
    assert leds.next() == SetLeds(False, False, True)
    assert drive.next() == SetVelocity(0.1, 0.0, 0.5)
    assert drive.next() == SetVelocity(0.1, 0.0, 0.5)  # claimed again
    assert display.next() == SetDisplay("pressed a", 3.0)
    press(a=5, b=1, c=0)
    rig.until_phase("fault", "r0")
    assert rig.progress["r0"].reason == f"Hands on r0, on_button() at k = 2: {app}, line 14: ValueError: not that one"
    drive.until(lambda message: message == SetVelocity(0.0, 0.0, 0.5))
    assert leds.until(lambda message: message.seconds < 0.1)
    display.until(lambda message: message.text == "")
    assert rig.stop("r0") == 3
    assert "Traceback" not in rig.log("r0")


def test_the_command_shows_and_changes_parameters(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, app = make_rig("hands", HANDS, ("r0",))
    rig.start("r0", "apps", app)
    rig.until_phase("running", "r0")
    monkeypatch.setenv("SWARM_CONFIG", str(rig.directory / "swarm.toml"))
    monkeypatch.setenv("SWARM_ROBOT", "r0")
    monkeypatch.setenv("SWARM_RUNTIME", str(rig.directory / "r0"))

    def param(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as end:
            main(["app", "param", *arguments])
        output = capsys.readouterr()
        return int(str(end.value.code)), output.out + output.err

    code, text = param("hands", "gain=0.75")
    assert code == 0
    assert text.splitlines() == [
        "parameter      r0          may be",
        "weights        metropolis  'metropolis' or 'row'",
        "gain           0.75        a finite number from 0 to 1 in 1/s",
        "fixed (fixed)  1           an integer",
    ]
    code, text = param("hands", "r0.gain=1.5")
    assert code == 1
    assert "app hands on r0: gain: expected a finite number from 0 to 1 in 1/s, got 1.5" in text
    assert json.loads(param("hands", "--json")[1])["parameters"] == {
        "r0": {"weights": "metropolis", "gain": 0.75, "fixed": 1}
    }
    assert param("hands", "gain")[1] == "swarm: 'gain' is no setting such as gain=0.5 or r2.gain=0.5\n"
    assert param("hands", "r7.gain=1")[1] == "swarm: no robot 'r7' here, there are r0\n"
    rig.stop("r0")
    monkeypatch.setattr(swarm_param, "PATIENCE", 0.5)
    assert param("hands") == (2, "swarm: no app hands answers on r0: does it run? (swarm status)\n")


def test_a_change_that_waits_for_a_running_handler_is_told_as_such(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, app = make_rig("busy", HANDS)
    gate = rig.directory / "gate"
    os.mkfifo(gate)
    text = Path(app).read_text().replace('if button == "b":', f'open("{gate}").close()\n        if button == "b":')
    Path(app).write_text(text.replace("Hands", "Busy"))
    rig.start("r0", "apps", app)
    rig.until_phase("running", "r0")
    out = Watch(rig, "r0", "swarm/r0/app/busy/out/pressed", AppOutput)
    for presses in (0, 1):
        rig.buses["r0"].publish("swarm/r0/balancer/buttons", Buttons(0.0, False, False, False, presses, 0, 0))
    assert out.next().values == {"value": "a"}
    monkeypatch.setenv("SWARM_CONFIG", str(rig.directory / "swarm.toml"))
    monkeypatch.setenv("SWARM_ROBOT", "r0")
    monkeypatch.setenv("SWARM_RUNTIME", str(rig.directory / "r0"))

    def param(*arguments: str) -> str:
        with pytest.raises(SystemExit) as end:
            main(["app", "param", "busy", *arguments])
        assert end.value.code == 0
        return capsys.readouterr().out

    text = param("gain=0.75")
    assert "gain           0.5 " in text
    assert text.endswith("r0: taken, and holds from the app's next step on\n")
    gate.write_text("")  # returns when the handler reads it
    monkeypatch.setattr(swarm_param, "PATIENCE", 20.0)
    text = param("gain=0.875")
    assert "gain           0.875 " in text
    assert "taken" not in text


def test_a_wrong_state_is_named_and_sigterm_gives_back_what_was_taken(make_rig: MakeRig) -> None:
    rig, app = make_rig("hands", HANDS, ("r0",))
    bus = rig.buses["r0"]
    drive = Watch(rig, "r0", "swarm/r0/balancer/set/velocity", SetVelocity)
    rig.start("r0", "apps", app)
    rig.until_phase("running", "r0")
    for presses in ((0, 0, 0), (1, 0, 0)):
        bus.publish("swarm/r0/balancer/buttons", encode(Buttons(0.0, False, False, False, *presses)))
    drive.until(lambda message: message.speed == 0.1)
    assert rig.stop("r0") == 0
    drive.until(lambda message: message == SetVelocity(0.0, 0.0, 0.5))
    rig.progress.clear()
    rig.start("r0", "apps", app)
    rig.until_phase("running", "r0")
    for presses in ((1, 0, 0), (1, 0, 1)):
        bus.publish("swarm/r0/balancer/buttons", encode(Buttons(0.0, False, False, False, *presses)))
    rig.until_phase("fault", "r0")
    where = f"Hands on r0, on_button() at k = 0: {app}, from line 7 on"
    assert rig.progress["r0"].reason == f"{where}: presses: expected an integer of 64 bits, got 'many'"


HANGS = """
import time
from swarm import PeriodicApp
class Hangs(PeriodicApp):
    period = 0.1
    def step(self, neighbours):
        self.robot.drive(0.1, 0.0)
        if self.k == 3:
            while True:
                pass
"""


@pytest.mark.slow
def test_a_handler_that_hangs_is_named_and_lets_go_of_the_drive(make_rig: MakeRig) -> None:
    rig, app = make_rig("hangs", HANGS, ("r0",))
    drive = Watch(rig, "r0", "swarm/r0/balancer/set/velocity", SetVelocity)
    rig.start("r0", "apps", app)
    rig.until_phase("fault", "r0")
    words = r"Hangs on r0, step 3: /.*hangs\.py, line (9|10), in step\(\): it has not ended within 10 s"
    assert re.fullmatch(words, rig.progress["r0"].reason)
    drive.until(lambda message: message.speed == 0.0)
    assert rig.stop("r0") == 3


SPINNING = """
from services.apps.host import event_host
from swarm import PeriodicApp
event_host.HANG = 0.5
class Spinning(PeriodicApp):
    period = {period}
    _spins: bool = False
    def start(self):
        self.robot.after(0.5, "spin")
    def on_timer(self, name):
        self._spins = {step} < 0
    def step(self, neighbours):
        self._spins = self.k == {step}
    def result(self):
        while self._spins: pass
        return {{"value": 1}}
"""


@pytest.mark.parametrize(("period", "step", "k"), [(0.1, 3, 3), (3600.0, -1, 1)])
def test_a_result_that_hangs_is_named_after_a_step_and_between_two(
    make_rig: MakeRig, period: float, step: int, k: int
) -> None:
    text = SPINNING.format(period=period, step=step)
    rig, app = make_rig("spinning", text, ("r0",))
    rig.start("r0", "apps", app)
    rig.until_phase("fault", "r0")
    where = rf"Spinning on r0, result\(\) at iteration {k}: /.*spinning\.py, line 15, in result\(\)"
    assert re.fullmatch(f"{where}: it has not ended within 0.5 s", rig.progress["r0"].reason)
    assert rig.stop("r0") == 3


CHANNELS = """
from swarm import PeriodicApp, SyncApp, channel
class Mean(SyncApp):
    value: float
    def step(self, neighbours):
        self.value += sum(w * (n.value - self.value) for w, n in self.weighted(neighbours))
class Largest(SyncApp):
    value: float
    def step(self, neighbours):
        self.value = max([self.value, *(n.value for n in neighbours)])
class Two(PeriodicApp):
    period = 0.05
    mean = channel(Mean)
    largest = channel(Largest, value=1.0)
    def start(self):
        self.mean.value = float(self.robot.name[1:])
    def step(self, neighbours):
        pass
    def result(self):
        return {"mean": self.mean.value, "largest": self.largest.value, "k": self.mean.k}
"""


def test_two_locksteps_run_inside_a_periodic_app(make_rig: MakeRig) -> None:
    rig, app = make_rig("two", CHANNELS, more="[apps.two.robots.r2]\nlargest_value = 7.5\n")
    rig.start_all(app)

    def agreed() -> bool:
        results = [state.result for state in rig.state.values()]
        return len(results) == 3 and all(
            result["largest"] == 7.5 and abs(float(result["mean"]) - 1.0) < 1e-6 for result in results
        )

    rig.until(agreed, "agreement on both")
    rig.kill("r1")
    at = rig.state["r0"].result["k"] + 10  # what the killed one has told is nearer to the others
    rig.state.clear()
    rig.start("r1", "apps", app)
    rig.until(agreed, "agreement on both")
    rig.until(lambda: all(state.result["k"] > at for state in rig.state.values()), "the lockstep goes on")
    assert {rig.stop(name) for name in NAMES} == {0}


FED = """
from swarm import PeriodicApp, SyncApp, channel
class Adding(SyncApp):
    value: float
    _input: float = 0.0
    def step(self, neighbours):
        self.value, self._input = self.value + self._input, 0.0
class Fed(PeriodicApp):
    inner = channel(Adding)
    def start(self):
        self.inner.feed(_input=1.0)
    def step(self, neighbours):
        pass
    def result(self):
        return {"value": self.inner.value, "k": self.inner.k}
"""


def test_an_input_from_the_start_of_an_app_counts_once_through_a_kill(make_rig: MakeRig) -> None:
    rig, app = make_rig("fed", FED, ("r0", "r1"))
    rig.start_all(app)

    def at(k: int) -> Callable[[], bool]:
        return lambda: all(name in rig.state and rig.state[name].result["k"] >= k for name in rig.names)

    rig.until(at(5), "iteration 5")
    rig.kill("r0")
    rig.state.clear()
    rig.start("r0", "apps", app)
    rig.until(at(1), "it goes on")
    rig.until(at(rig.state["r0"].result["k"] + 5), "more iterations")
    assert rig.state["r0"].result["value"] == 1.0


LIVE = """
from swarm import SyncApp, parameter
class Live(SyncApp):
    value: float
    gain: float = parameter(0.5, low=0, high=1, live=True)
    fixed: float = parameter(0.5)
    def step(self, neighbours):
        self.value = self.gain
        self.robot.leds(red=True)
"""


def test_live_parameters_of_a_synchronous_app_hold_through_a_kill(make_rig: MakeRig) -> None:
    rig, app = make_rig("live", LIVE, ("r0", "r1"))
    answers = Watch(rig, "r0", "swarm/r0/app/live/parameters_set", AppParametersSet)
    leds = Watch(rig, "r0", "swarm/r0/balancer/set/leds", SetLeds)
    rig.start_all(app)
    rig.until_k(3)
    bus = rig.buses["r0"]
    bus.publish("swarm/r0/app/live/set/parameters", SetAppParameters("t1", {"fixed": 0.25}))
    assert answers.next().problem.startswith("app live on r0: fixed: cannot be changed while the app runs")
    bus.publish("swarm/r0/app/live/set/parameters", SetAppParameters("t2", {"gain": 0.25}))
    assert answers.next().problem == ""
    rig.until(lambda: rig.state["r0"].state["value"] == 0.25, "the new gain")
    rig.kill("r0")
    at = max(state.k for state in rig.state.values()) + 3
    rig.state.clear()
    rig.start("r0", "apps", app)
    rig.until_k(at)
    rig.until(lambda: rig.state.get("r0") is not None and rig.state["r0"].state["value"] == 0.25, "the gain as changed")
    rig.until(lambda: rig.state.get("r1") is not None and rig.state["r1"].state["value"] == 0.5, "the other's own")
    assert rig.stop("r0") == 0
    assert leds.until(lambda message: message.seconds < 0.1)
