"""`swarm commission` as a person does it: at a terminal, with the robot of a running simulation in the hand.

The person reads what is printed, does it with the words of `swarm hand`, and answers by Enter or by the robot's
button A in turn.
"""

import itertools
import json
import os
import pty
import re
import select
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import wait_until

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.messages import BalancerState, read
from swarm.process.simulations import is_live

ROOT = Path(__file__).parents[2]
LOW_POWER = 0.2
"""Duty that no motor may exceed before the robot stands."""
HAND_S = 1.5
"""What a hand takes for an act; then the person looks, and answers."""
SEED = "278"
"""A gyro whose zero differs little between the ways to mount it: only here is it mounted anew while the robot is on."""
PLACE = re.compile(r"at x = (\S+) m, y = (\S+) m")

ACTS = (
    (PLACE, "place r0 {0} {1}"),
    (re.compile(r"Press button ([ABC])"), "press r0 {0}"),
    (re.compile(r"Turn the (left|right) wheel"), "roll r0 {0}"),
    (re.compile("on its back"), "lay r0 back"),
    (re.compile("on its front"), "lay r0 front"),
    (re.compile("to the left by a quarter turn"), "lift r0 --turn 90"),
    (re.compile("forward by a quarter turn"), "lift r0 --tilt 90"),
    (re.compile("on the floor"), "lift r0 --down"),
    (re.compile(r"(?i)tip it .*forward"), "lift r0 --tilt 15"),
    (re.compile(r"(?i)tip it .*backward"), "lift r0 --tilt -15"),
    (re.compile("hand|upright"), "lift r0"),
)
"""What is asked, and how the hand does it; the first that fits."""

CONFIG = """network = "test"
[[robots]]
name = "r0"
[[anchors]]
address = "D001"
x = 0.0
y = 0.0
[[anchors]]
address = "D002"
x = 2.0
y = 0.0
[[anchors]]
address = "D003"
x = 0.0
y = {far}
[simulation]
scl = {scl}
[simulation.places]
r0 = [1.0, 1.0, 0.0]
"""

FAULTS = (
    ("imu-mirrored", "mirrored"),
    ("left-encoder", "the left encoder is reversed"),
    ("right-encoder", "the right encoder is reversed"),
    ("left-motor", "the left motor is reversed"),
    ("right-motor", "the right motor is reversed"),
)
"""Parts in the order in which the steps find them, and what they say. The other two ways to mount an IMU turn gravity
over, which cannot happen to a robot that is switched on (tests/swarm/onboard/test_commission.py has them)."""


class Person:
    """One at a terminal, beside a robot that a simulation of its own holds."""

    def __init__(self, folder: Path, runtime: Path, *, scl: float = 100e3, far: float = 2.0) -> None:
        (folder / "swarm.toml").write_text(CONFIG.format(scl=scl, far=far))
        self.folder = folder
        self.run_dir = runtime / "run"
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(runtime)}
        words = ["sim", "--config", "swarm.toml", "--lying", "back", "--run-dir", str(self.run_dir), "--seed", SEED]
        with (folder / "sim.log").open("w") as log:
            self._simulation = subprocess.Popen(
                self._words(*words), cwd=folder, env=self.environment, stdin=subprocess.PIPE, stdout=log, stderr=log
            )
        self._bus: Bus | None = None
        self._states: list[BalancerState] = []
        self._answers = itertools.cycle(("enter", "button"))
        self.said: list[str] = []
        self.asked: list[str] = []
        self.duty = 0.0
        """Largest so far of either motor."""

    def _words(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "laptop.cli", *words]

    def wait_there(self) -> None:
        """Until the robot speaks."""
        place = self.run_dir / "r0"
        wait_until(lambda: is_live(self.run_dir) and (place / "body.sock").exists(), 60)
        self._bus = Bus.of(place)

        def take(key: str, payload: bytes) -> None:
            state = read(key, payload)
            assert isinstance(state, BalancerState)
            self._states.append(state)
            self.duty = max(self.duty, abs(state.duty_left), abs(state.duty_right))

        self._bus.subscribe("swarm/r0/balancer/state", take)
        wait_until(lambda: self._states and self._states[-1].posture == "back", 60)

    def hand(self, words: str) -> None:
        """Do something with the robot."""
        self._do("hand", *words.split())

    def _do(self, *words: str) -> None:
        done = subprocess.run(
            [*self._words(*words), "--run-dir", str(self.run_dir)],
            env=self.environment, check=False, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr

    def commission(self, mend: Callable[[], bool]) -> dict[str, Any]:
        """Do all that is asked until it has ended; `mend`: what the person does about a fault, False: gives up. Its
        report."""
        ours, theirs = pty.openpty()
        words = self._words("commission", "r0", "--run-dir", str(self.run_dir), "--out", "report.json")
        command = subprocess.Popen(
            words, cwd=self.folder, env=self.environment, stdin=theirs, stdout=theirs, stderr=theirs
        )
        os.close(theirs)
        try:
            for line in lines(ours):
                self.said.append(line)
                if line.startswith("  ? "):
                    self._answer(line.removeprefix("  ? "), ours, mend)
            code = command.wait(60)
        finally:
            command.kill()
            command.wait()
            os.close(ours)
        report: dict[str, Any] = json.loads((self.folder / "report.json").read_text())
        assert code == (0 if report["verdict"] == "passed" else 1)
        return report

    def _answer(self, question: str, terminal: int, mend: Callable[[], bool]) -> None:
        self.asked.append(question)
        if question.startswith("Mended?"):
            os.write(terminal, b"\r" if mend() else b"n")
            return
        for pattern, act in ACTS:
            if (found := pattern.search(question)) is not None:
                self.hand(act.format(*found.groups()))
                self._look()
                break
        if "A or Enter" in question:
            if next(self._answers) == "enter":
                os.write(terminal, b"\r")
            else:
                self.hand("press r0 A")

    def _look(self) -> None:
        """Wait until the robot has told of the `HAND_S` after now."""
        seen = clock.now() + HAND_S
        wait_until(lambda: self._states[-1].t > seen, what="what the robot tells of itself")

    def close(self) -> None:
        """End all."""
        if self._bus is not None:
            self._bus.close()
        self._simulation.terminate()
        self._simulation.communicate(timeout=60)


def lines(terminal: int) -> Iterator[str]:
    """What a program writes at a terminal, until it has gone."""
    rest, said = "", [""]
    while True:
        assert select.select([terminal], [], [], 100)[0], f"it says nothing any more; last: {said[-3:]}"
        try:
            rest += os.read(terminal, 4096).decode()
        except OSError:  # its end is closed
            return
        *whole, rest = rest.split("\n")
        for line in whole:
            said.append(line.rstrip("\r"))
            yield said[-1]


@pytest.fixture
def person(tmp_path: Path, runtime: Path, request: pytest.FixtureRequest) -> Iterator[Person]:
    made = Person(tmp_path, runtime, **getattr(request, "param", {}))
    try:
        made.wait_there()
        yield made
    finally:
        made.close()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_each_part_that_is_mounted_wrong_is_named_and_mended_and_the_robot_stands(person: Person) -> None:
    faults = iter(FAULTS)
    mounted, text = next(faults)
    person.hand(f"miswire r0 {mounted}")
    failures: list[str] = []

    def mend() -> bool:
        nonlocal mounted, text
        assert person.duty <= LOW_POWER
        failures.append(person.said[-3])
        assert text in failures[-1]
        person.hand(f"miswire r0 {mounted} --back")
        mounted, text = next(faults, ("", ""))
        if mounted:
            person.hand(f"miswire r0 {mounted}")
        return True

    report = person.commission(mend)
    assert report["verdict"] == "passed", person.said[-20:]
    assert len(failures) == len(FAULTS), failures
    assert "swarm calibrate offset report.json --robots r0 --write" in person.said[-1]


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("person", "step", "named", "duty"),
    [
        ({"scl": 62500.0}, "bus", "SCL is some 6", 0.0),
        ({"far": 300.0}, "uwb", "not heard: anchor D003", LOW_POWER),
    ],
    indirect=["person"],
)
def test_a_slow_bus_and_a_dead_anchor_are_named_and_no_motor_reaches_full_power(
    person: Person, step: str, named: str, duty: float
) -> None:
    report = person.commission(lambda: False)
    failed = [row for row in report["steps"] if row["verdict"] == "failed"]
    assert [row["name"] for row in failed] == [step]
    assert named in failed[0]["text"]
    assert any(named in line for line in person.said if line.startswith("FAILED"))
    assert person.duty <= duty
    assert not any("on the floor" in question for question in person.asked)
