"""Commissioning under virtual time: a simulated robot with its balancer and slack tasks, and a person's hand.

The person does what is asked for (`HAND`), and answers yes when it is done. What the motors were given is kept.
"""

import logging
import math
import random
from collections.abc import Callable

from services.balancer.balancer import Balancer
from services.balancer.bridge.orders import halt, obey
from services.balancer.core.control.body import body_model
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices.display import ScreenText
from services.balancer.slack_tasks import SlackTasks
from services.balancer.telemetry import Telemetry
from sim.core.balboa import BalboaBody
from sim.core.devices import SimulatedRobot, draw_errors
from sim.devices.i2c import SimulatedBus
from swarm.config.types import Body
from swarm.messages import Arm, Firmware, Links, LinkState, Range, Ranges, SetDisplay, Stop
from swarm.onboard.commission.core.procedure import Action, Ask, Procedure, SendCommand, Subject
from swarm.onboard.commission.core.steps import STEPS

ANCHORS = ("C933", "D10A", "4F21")
PLACES = {"C933": (0.0, 0.0, 0.0), "D10A": (2.0, 0.0, 0.0), "4F21": (1.0, 2.0, 0.0)}
OFFSET = 0.05
"""m by which this robot's ranges are too long."""
SUBJECT = Subject("r0", PLACES, 6.6, "2026-11-23", "test")
HAND: dict[str, Callable[[BalboaBody], None]] = {
    "lay-back": lambda body: body.lay(-1),
    "lay-front": lambda body: body.lay(1),
    "lay-in-sight": lambda body: body.lay(-1),
    "lift-upright": lambda body: body.lift(0.0, 0.0),
    "tip-forward": lambda body: body.lift(math.pi / 2, 0.0),
    "turn-left": lambda body: body.lift(0.0, math.pi / 2),
    "roll-left": lambda body: body.roll(math.tau, 0.0),
    "roll-right": lambda body: body.roll(0.0, math.tau),
    "tip-a-bit-forward": lambda body: body.lift(0.26, 0.0),
    "tip-a-bit-backward": lambda body: body.lift(-0.26, 0.0),
    "stand-on-floor": lambda body: body.stand(),
}
ACT_S, DONE_S = 0.2, 1.6
"""Until the person has understood, and until the act is done."""
PRESS_S = 0.2
_log = logging.getLogger("test")


class World:
    """One robot on the desk."""

    def __init__(self, *, seed: int = 1, scl: float = 100e3, anchors: tuple[str, ...] = ANCHORS) -> None:
        model, noise = body_model("zero2w", Body()), random.Random(seed)
        self.now = self.deadline = 100.0
        self.body = BalboaBody(model, self.now, tilt=-1.9, held=False)
        self.largest_duty = 0.0
        self._drive = self.body.drive
        self.body.drive = self._driven  # type: ignore[method-assign]
        self.robot = SimulatedRobot(self.body, noise, errors=draw_errors(noise))
        self.robot.scl = scl
        self.bus = SimulatedBus(self.robot, self.clock)
        self.balancer = Balancer(self.bus, model, 0.0, self.clock, self._pass, start_mode="rest")
        self.tasks = SlackTasks(self.balancer, self.clock)
        self.telemetry = Telemetry(self.balancer, "lqr")
        self.procedure = Procedure(SUBJECT, STEPS)
        self.heard = anchors
        self.place = (0.0, 0.0)
        self.wrong: dict[str, float] = {}
        """By how much ranges to an anchor are too long, m."""
        self.declined: set[str] = set()
        """First words of what the person says no to."""
        self.said: list[str] = []
        self.asked: list[str] = []
        self.mend: Callable[[World], bool] = lambda _: False
        """What the person does about a step that failed; False: gives up."""
        self._noise, self._tick = noise, 0
        self._acts: list[tuple[float, Callable[[], object]]] = []
        self._stop: Stop | None = None

    def clock(self) -> float:
        self.now += 50e-6
        return self.now

    def _pass(self, seconds: float) -> None:
        self.now += seconds

    def _driven(self, left: float, right: float) -> None:
        self.largest_duty = max(self.largest_duty, abs(left), abs(right))
        self._drive(left, right)

    def run(self, seconds: float = 400.0) -> "World":
        """Go on until the procedure has ended, at most so long."""
        end = self.deadline + seconds
        while not self.procedure.done and self.deadline < end:
            self._run_tick()
        assert self.procedure.done, self.said[-3:]
        return self

    @property
    def failed(self) -> tuple[str, str, str]:
        """Name of the step that failed, what is wrong and what to mend."""
        found = [row for row in self.procedure.report()["steps"] if row["verdict"] == "failed"]
        assert len(found) == 1, found
        return found[0]["name"], found[0]["text"], found[0]["remedy"]

    def figures(self, step: str) -> dict[str, object]:
        return next(row["figures"] for row in self.procedure.report()["steps"] if row["name"] == step)

    def _run_tick(self) -> None:
        self.now = max(self.now, self.deadline)
        self.balancer.step(self.now)
        self.balancer.show_leds(self.now)
        self.deadline += PERIOD_S
        if self.now > self.deadline:
            self.deadline += ((self.now - self.deadline) // PERIOD_S + 1) * PERIOD_S
        for message in self.tasks.run(self.deadline):
            self._tell(message)
        self._tick += 1
        if self._tick % 4 == 0:
            self._tell(self.telemetry.state(self._tick, 0, 0, (1e-4, 2e-4), self.tasks.behind))
            if (odometry := self.telemetry.odometry()) is not None:
                self._tell(odometry)
        elif (news := self.telemetry.news()) is not None:
            self._tell(news)
        if self._tick % 10 == 0:
            self._tell_ranges()
        if self._tick % 100 == 0:
            self._tell(Firmware(self.now, *(self.balancer.firmware or (0, 0))))
            self._tell(Links(self.now, (LinkState("r1", "up", 1, 0.03, 1, 1, "", rtt_median=0.031),)))
            if self._stop is not None:
                halt(self.balancer, self._stop)
        due = [act for at, act in self._acts if at <= self.now]
        self._acts = [(at, act) for at, act in self._acts if at > self.now]
        for act in due:
            act()
        if self._tick % 5 == 0:
            self._do(self.procedure.handle_timer(self.now))

    def _tell(self, message: object) -> None:
        self._do(self.procedure.receive(message, self.now))

    def _tell_ranges(self) -> None:
        def measured(name: str) -> Range:
            distance = math.dist((*self.place, 0.0), PLACES[name]) + OFFSET + self.wrong.get(name, 0.0)
            distance += self._noise.gauss(0.0, 0.02)
            return Range(name, distance, distance, 90, 0.0, self._tick)

        rows = tuple(map(measured, self.heard))
        self._tell(Ranges(self.now, self._tick, rows))

    def _do(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, SendCommand):
                self._command(action.message)
            elif isinstance(action, Ask):
                self._hand(action)
            else:
                self.said.append(action.text)

    def _command(self, message: object) -> None:
        match message:
            case Stop():
                self._stop = message
                halt(self.balancer, message)
            case Arm():
                self._stop = None
            case SetDisplay(text):
                self.tasks.obey(ScreenText(tuple(text.split("\n"))), self.now)
            case _:
                assert obey(self.balancer, message, self.now, _log) or self.tasks.obey(message, self.now), message

    def _hand(self, ask: Ask) -> None:
        self.asked.append(ask.what)
        at = self.now + ACT_S
        if ask.what == "again":
            self._acts.append((at, lambda: self._do(self.procedure.answer(self.mend(self), self.now))))
            return
        if ask.what.startswith("press-"):
            bit = 1 << "abc".index(ask.what[-1])
            self._acts += [
                (at, lambda: self.robot.atmega.press(bit)),
                (at + PRESS_S, lambda: self.robot.atmega.press(0)),
            ]
        elif ask.what.startswith("lay-at "):
            x, y = map(float, ask.what.split()[1:])
            self.place = (x, y)
        elif ask.what in HAND:
            self._acts.append((at, lambda: HAND[ask.what](self.body)))
        if ask.answered:
            yes = ask.what.partition(" ")[0] not in self.declined
            self._acts.append((at + DONE_S, lambda: self._do(self.procedure.answer(yes, self.now))))
