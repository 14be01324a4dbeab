"""Inside a machine: r0 is all of a robot, on systemd, with the firmware in the AVR simulator; r1 to r5 are meshes and
apps in the same machine, told what their modules would measure. Each has an adapter of the machine's kernel.

Figure 4.8 of the thesis, as filmed: the robot balances while it localizes. Figure 3.16: two messages cross.
"""

import math
import random
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import Processes
from inside_swarm import APPS, NAMES, SHARE, Swarm, come

from lab.i2c.order import order
from lab.radio.remote import Radio
from lab.waiting import until
from services.balancer.core.devices import balboa
from services.dwm.core.module.tlv import NOWHERE
from sim.core.uwb import Module, Tag, error_model
from swarm import clock
from swarm.app.overlays import Overlays
from swarm.bus.zenoh_bus import Bus
from swarm.config import Config, load
from swarm.messages import (
    AppProgress,
    AppState,
    BalancerState,
    Firmware,
    Members,
    Passed,
    Pose,
    Range,
    Ranges,
    SetMode,
    Uwb,
    read,
)

WHOLE, OTHERS = NAMES[0], NAMES[1:]
REPORT_S = 0.1
SETTLED = 20
"""Iterations before which an estimate is right by chance."""
BALANCED_S = 6.0
"""Seconds for which the robot is watched while it localizes."""
TILT = 0.2
WINDOW = 12
"""States, at 25 Hz, within which a loop that its host keeps from computing leaves out ticks enough for a fall."""
TICKS_LEFT_OUT = 10
REPORTS_HZ = 9.0


class Modules:
    """What the modules of robots that have none would measure, told on their buses at 10 Hz."""

    def __init__(self, swarm: Swarm, config: Config) -> None:
        self._swarm, self._config = swarm, config
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        config = self._config
        target = config.dwm.target
        assert target is not None
        around = [Module(target, *config.simulation.target, 0.0, NOWHERE)]
        tags = {name: Tag(random.Random(name), error_model(config.simulation.range_noise)) for name in OTHERS}
        number = 0
        while not self._end.wait(REPORT_S):
            number += 1
            for name, tag in tags.items():
                x, y, _ = config.simulation.places[name]
                now, bus = clock.now(), self._swarm.buses[name]
                found = tag.measure(around, x, y, 0.0, 0.0).ranges
                ranges = tuple(Range(target, each.distance, each.distance, each.quality, 0.0, number) for each in found)
                bus.publish(f"swarm/{name}/dwm/ranges", Ranges(now, number, ranges))
                bus.publish(f"swarm/{name}/dwm/pose", Pose(now, number, x, y, None, 90, "external"))

    def close(self) -> None:
        self._end.set()
        self._thread.join()


class Robot:
    """The whole one, by what it says on its bus."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.states: list[BalancerState] = []
        self.uwb: list[Uwb] = []
        self.firmware: Firmware | None = None
        self.pose: Pose | None = None
        self.app: AppState | None = None
        self.progress: AppProgress | None = None
        bus.subscribe(f"swarm/{WHOLE}/balancer/state", lambda key, data: self.states.append(read(key, data)))
        bus.subscribe(f"swarm/{WHOLE}/balancer/uwb", lambda key, data: self.uwb.append(read(key, data)))
        bus.subscribe(f"swarm/{WHOLE}/balancer/firmware", self._on_firmware)
        bus.subscribe(f"swarm/{WHOLE}/dwm/pose", self._on_pose)
        bus.subscribe(f"swarm/{WHOLE}/app/localization/state", self._on_app)
        bus.subscribe(f"swarm/{WHOLE}/app/localization/progress", self._on_progress)

    def _on_firmware(self, key: str, data: bytes) -> None:
        self.firmware = read(key, data)

    def _on_pose(self, key: str, data: bytes) -> None:
        self.pose = read(key, data)

    def _on_app(self, key: str, data: bytes) -> None:
        self.app = read(key, data)

    def _on_progress(self, key: str, data: bytes) -> None:
        self.progress = read(key, data)

    @property
    def mode(self) -> str:
        return self.states[-1].mode if self.states else ""

    def stand(self) -> None:
        """Tell it to, until it does: one that lies so that it must be turned over has several tries."""
        again = 0.0

        def stands() -> bool:
            nonlocal again
            if self.mode in ("idle", "fault") and time.monotonic() > again:
                self.bus.publish(f"swarm/{WHOLE}/balancer/set/mode", SetMode("stand"))
                again = time.monotonic() + 2.0
            return self.mode == "balancing"

        until("the robot stands", stands, 60.0, self.said)

    def said(self) -> str:
        state, uwb = self.states[-1:], self.uwb[-1:]
        return f"{state}, {uwb}, {self.pose}, bus {order('/run/lab/orders', {})}, {self.app}, {self.progress}"


@pytest.fixture(scope="module")
def config() -> Config:
    return load(SHARE / "thesis.toml")


@pytest.fixture(scope="module")
def robot() -> Iterator[Robot]:
    with Bus.of(Path("/run/swarm")) as bus:
        assert bus.wait_connected(60.0)
        yield Robot(bus)


@pytest.fixture(scope="module")
def swarm(radio: Radio, config: Config, robot: Robot) -> Iterator[Swarm]:
    """All six in a loop; r0's services are those of systemd."""
    with tempfile.TemporaryDirectory(prefix="sw", dir="/tmp") as folder:
        made = Swarm(Processes(Path(folder)), "thesis", OTHERS)
        modules = Modules(made, config)
        try:
            made.start_meshes()
            yield made
            made.end()
        finally:
            modules.close()
            made.close()


@pytest.fixture(autouse=True)
def _whole_again() -> None:
    """In place of that of `inside_radio`: the radio stays as it is between the tests of this file."""


def note(text: str) -> None:
    """Tell the host what was measured."""
    with (SHARE / "measured").open("a") as file:
        file.write(text + "\n")


def test_the_firmware_answers_and_asks_its_module(robot: Robot) -> None:
    until("the ATmega is named", lambda: robot.firmware is not None, 60.0, robot.said)
    assert robot.firmware is not None
    assert robot.firmware.layout == balboa.LAYOUT_VERSION
    until("the firmware has asked the module", lambda: robot.uwb and robot.uwb[-1].state == "ok", 60.0, robot.said)


def test_a_robot_balances_while_it_localizes(robot: Robot, swarm: Swarm, config: Config) -> None:
    robot.stand()
    place = config.simulation.places[WHOLE][:2]
    until(
        "it knows where it is",
        lambda: robot.pose is not None and math.dist((robot.pose.x, robot.pose.y), place) < 0.3,
        30.0,
        robot.said,
    )
    Path("/etc/swarm/apps").mkdir(exist_ok=True)
    Path("/etc/swarm/apps/localization.env").write_text("ARGUMENTS=--run 1ab\n")
    subprocess.run(["systemctl", "start", "--no-block", "swarm-app@localization"], check=True)
    for name in OTHERS:
        swarm.start(APPS, name, "localization", "--run", "1ab")

    def off() -> float:
        if robot.app is None or robot.app.k < SETTLED:
            return math.inf
        return math.dist((robot.app.result["x"], robot.app.result["y"]), config.simulation.target)

    began = time.monotonic()
    swarm.wait("the target is found", lambda: off() < 0.15, lambda: f"{robot.said()}, {links(swarm)}")
    found = time.monotonic() - began
    assert robot.app is not None
    for _ in range(3):
        robot.stand()
        robot.states.clear()
        robot.uwb.clear()
        first = robot.app.k
        time.sleep(BALANCED_S)
        states, uwb, app = [*robot.states], [*robot.uwb], robot.app
        if not kept_from_computing(states):
            break
    assert {state.mode for state in states} == {"balancing"}, robot.said()
    tilt = max(abs(state.tilt) for state in states)
    reports = len({each.sequence for each in uwb if each.state == "ok"}) / BALANCED_S
    ticks = (states[-1].ticks - states[0].ticks) / (states[-1].t - states[0].t)
    note(
        f"target found after {found:.1f} s, {100 * off():.1f} cm off; then "
        f"{(app.k - first) / BALANCED_S:.1f} iterations, {ticks:.0f} ticks and {reports:.1f} reports a second, "
        f"tilt up to {tilt:.2f} rad, behind with: {states[-1].behind or 'nothing'}"
    )
    assert app.k > first
    assert tilt < TILT
    # A host that is too slow for all ticks is too slow for all reports.
    assert reports >= REPORTS_HZ * min(1.0, ticks / 100.0)


def test_two_unicast_messages_cross_in_a_loop_of_six(robot: Robot, swarm: Swarm) -> None:
    """Figure 3.16: r1 to r3 and r2 to r4 in a loop of six, at the same time, each by its shorter way."""
    passed: list[tuple[str, Passed]] = []

    def noting(name: str) -> Callable[[str, bytes], None]:
        return lambda key, data: passed.append((name, read(key, data)))

    apps = {name: Overlays(swarm.buses[name], name, "crossing") for name in OTHERS}
    for name in OTHERS:
        swarm.buses[name].subscribe(f"swarm/{name}/mesh/passed", noting(name))
        apps[name].collect()
    for one, other in (("r1", "r3"), ("r2", "r4")):
        swarm.wait(f"{one} reaches {other} by two hops", lambda one=one, other=other: hops(swarm, one, other) == 2)
    time.sleep(0.5)  # until the routers know who listens
    robot.stand()
    robot.states.clear()
    for handle in (apps["r1"].send("r3", b"from r1"), apps["r2"].send("r4", b"from r2")):
        assert handle.result(30.0).delivered
    assert come(apps["r3"], 1) == [("r1", b"from r1", False)]
    assert come(apps["r4"], 1) == [("r2", b"from r2", False)]

    def ways() -> dict[tuple[str, str], list[tuple[str, str]]]:
        """Who has passed a message on and to whom, in order; on a busy machine one is sent, and passed on, again."""
        there: dict[tuple[str, str], list[tuple[str, str]]] = {}
        for name, each in sorted(passed, key=lambda item: item[1].t):
            if not each.back:
                there.setdefault((each.sender, each.to), []).append((name, each.next))
        return {ends: list(dict.fromkeys(steps)) for ends, steps in there.items()}

    wanted = {("r1", "r3"): [("r1", "r2"), ("r2", "r3")], ("r2", "r4"): [("r2", "r3"), ("r3", "r4")]}
    until("both ways are told", lambda: ways() == wanted, 10.0, ways)
    states = [*robot.states]
    assert {state.mode for state in states} == {"balancing"} or kept_from_computing(states), robot.said()


def kept_from_computing(states: list[BalancerState]) -> bool:
    """Whether the host was so busy that the loop left out ticks enough for a fall, which is no fault of the robot."""
    missed = [each.missed for each in states]
    return any(missed[i + WINDOW] - missed[i] >= TICKS_LEFT_OUT for i in range(len(missed) - WINDOW))


def links(swarm: Swarm) -> dict[str, list[str]]:
    """Whom each robot reaches, as its mesh has it."""
    return {
        name: [each.robot for each in swarm.ask(name, "members").members if each.state == "here"] for name in OTHERS
    }


def hops(swarm: Swarm, one: str, other: str) -> int | None:
    """From one robot to the other, as its mesh has it."""
    members: Members = swarm.ask(one, "members")
    return next((each.hops for each in members.members if each.robot == other and each.state == "here"), None)
