"""Apps in their own processes, on real meshes: messages beyond the neighbours, and the swarm's common time."""

import os
import time
from pathlib import Path

from conftest import wait_until
from mesh_rig import Build, Swarm, build
from test_mesh_overlay_process import LINE, wait_here

from swarm.messages import AppState, read

__all__ = ["build"]

EXAMPLE = Path(__file__).parents[4] / "examples/roll_call.py"

CLOCKS = """\
import time
from swarm import SyncApp

class Clocks(SyncApp):
    mesh: float
    error: float
    true: float

    def step(self, neighbours):
        clock = self.robot.clock
        now, self.true = clock.now(), time.clock_gettime(time.CLOCK_MONOTONIC)
        if now is not None and clock.root == self.robot.swarm[0]:
            self.mesh, self.error = now, clock.error
        time.sleep(0.05)
"""

SKEWED = """\
import os, time
_offset, _rate = map(float, os.environ["SKEW"].split())
_true = time.monotonic
time.monotonic = lambda: _true() * (1.0 + _rate) + _offset
"""
"""A sitecustomize.py: the clock of a robot of its own, seen from all of the robot's processes."""

SKEWS = {"r0": (5000.0, 30e-6), "r1": (12000.0, -30e-6), "r2": (123.0, 10e-6)}
"""s, s/s. None is behind the machine's own clock: one that has just booted has no time before zero."""

READING = 20e-6
"""s between the app's looks at the two clocks that are compared."""


def states(swarm: Swarm, app: str) -> dict[str, AppState]:
    """The newest state of each robot, from now on."""
    found: dict[str, AppState] = {}
    for name, robot in swarm.robots.items():
        robot.bus.subscribe(
            f"swarm/{name}/app/{app}/state",
            lambda key, payload, name=name: found.__setitem__(name, read(key, payload)),  # type: ignore[misc]
        )
    return found


def start_apps(swarm: Swarm, app: Path, **environment: str) -> None:
    for name, robot in swarm.robots.items():
        swarm.processes.start_ready(
            "-m", "services.apps", str(app), "--run", "1",
            SWARM_ROBOT=name, SWARM_RUNTIME=str(robot.directory), SWARM_CONFIG=str(swarm["r0"].config), **environment,
        )  # fmt: skip


def test_an_app_calls_all_robots_and_hears_their_answers(build: Build) -> None:
    swarm = build(edges=LINE, model="latency=0.005")
    found = states(swarm, "roll_call")
    swarm.start()
    wait_here(swarm)
    start_apps(swarm, EXAMPLE)
    wait_until(lambda: "r0" in found and found["r0"].state == {"reached": 3, "answers": 3}, what="all answered")
    assert all(state.state == {"reached": 0, "answers": 0} for name, state in found.items() if name != "r0")


def test_apps_read_the_same_time_although_their_robots_clocks_differ(build: Build, runtime: Path) -> None:
    """By hours, and they run apart by 0.06 ms a second."""
    swarm = build("tcp", edges=(("r0", "r1"), ("r1", "r2")), times="heartbeat = 0.1\n")
    found = states(swarm, "clocks")
    (runtime / "site").mkdir()
    (runtime / "site/sitecustomize.py").write_text(SKEWED)
    (runtime / "clocks.py").write_text(CLOCKS)
    for name, robot in swarm.robots.items():
        place = {"SWARM_ROBOT": name, "SWARM_RUNTIME": str(robot.directory), "SWARM_CONFIG": str(robot.config)}
        own = skewed(runtime, name)
        robot.mesh = swarm.processes.start_ready("-m", "services.mesh", **place, **own)
        own_app = {**place, "SWARM_CONFIG": str(swarm["r0"].config), **own}
        swarm.processes.start_ready("-m", "services.apps", str(runtime / "clocks.py"), "--run", "1", **own_app)
    offset, rate = SKEWS["r0"]

    def agree() -> bool:
        """Everybody's mesh time is the first robot's clock, within four times the stated standard deviation."""
        shown = {name: state.state for name, state in found.items()}
        if len(shown) < 3 or not all(each["mesh"] for each in shown.values()):
            return False
        return all(
            abs(each["mesh"] - (each["true"] * (1.0 + rate) + offset)) <= 4 * each["error"] + READING
            for each in shown.values()
        )

    wait_until(agree, what="mesh times agree")
    own = found["r1"].t
    assert abs(own - time.monotonic() - SKEWS["r1"][0]) < 100, "what the host calls now is its own clock"


def skewed(runtime: Path, name: str) -> dict[str, str]:
    path = os.pathsep.join(filter(None, (str(runtime / "site"), os.environ.get("PYTHONPATH"))))
    return {"PYTHONPATH": path, "SKEW": "{} {}".format(*SKEWS[name])}


HERALD = """\
from swarm import PeriodicApp

class Herald(PeriodicApp):
    count: int
    heard: int
    near: int
    period = 0.1
    _ticket: str = ""

    def step(self, neighbours):
        self.count += 1
        self.near = sum(1 for n in neighbours if n.count > 0 and n.age < 2)
        if self.robot.name == self.robot.swarm[0] and self.count == 5:
            self._ticket = self.robot.flood(b"oyez").ticket

    def on_message(self, message):
        self.heard += 1
        if message.flooded:
            self.robot.send(message.sender, b"heard")

    def on_answer(self, ticket, outcome):
        if ticket == self._ticket:
            self.heard += 100 * len(outcome.robots)
"""


def test_a_periodic_app_over_real_meshes(build: Build, runtime: Path) -> None:
    """Its states reach the neighbours by the relay rule that is always there, its messages all robots."""
    (runtime / "herald.py").write_text(HERALD)
    swarm = build(edges=LINE, model="latency=0.005")
    found = states(swarm, "herald")
    swarm.start()
    wait_here(swarm)
    start_apps(swarm, runtime / "herald.py")
    wanted = {"r0": (1, 303), "r1": (2, 1), "r2": (2, 1), "r3": (1, 1)}
    wait_until(
        lambda: {name: (each.state["near"], each.state["heard"]) for name, each in found.items()} == wanted,
        what="all have heard all",
    )
