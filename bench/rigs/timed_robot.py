"""One robot whose I2C transfers, pauses and computation take their time under virtual time.

The balancer and its slack tasks are the robot's own code. The loop is that of `services.balancer.loop`, on a clock that
only moves when something takes time: bytes on the wire at the SCL that is given, the pauses of the ATmega, and the
CPU time of a tick. The UWB module answers every poll of the ATmega.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass

from services.balancer.balancer import Balancer
from services.balancer.bridge.link import LoopMessage
from services.balancer.core.control.body import body_model
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices.display import ScreenText
from services.balancer.slack_tasks import SlackTasks
from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location, Position, encode_location
from sim.core.balboa import BalboaBody
from sim.core.devices import SimulatedRobot, draw_errors
from sim.devices.i2c import SimulatedBus
from swarm.config.types import Body
from swarm.messages import Battery, Buttons, Display, Uwb

ANSWER_TICKS = 2
"""Between the ATmega's poll and the answer of its UWB module: 20 ms."""
CPU_PARTS = 5
"""Of a tick's CPU time a fifth each goes before the four transfers of the control step, and a fifth after them."""
WARM_UP_S = 6.0
"""At most, until it balances."""
PRESS_TICKS = 20


@dataclass(frozen=True)
class TimedResult:
    """What a robot did in some seconds of balancing, see `TimedRobot.measure`."""

    upright: bool
    missed: int
    """Ticks left out because the one before took too long."""
    uwb: float
    """Reports a second."""
    battery: float
    """Battery readings a second."""
    presses: float
    """Share of the presses of a button that were told."""
    screen_s: float | None
    """Until two changed lines stood on the display; None where they did not."""
    step_max: float
    """The longest control step, s."""
    behind: frozenset[str]
    """Tasks for which there was no time, as `balancer/state` names them."""


class ComputingBus(SimulatedBus):
    """Before each transfer comes what its process has to compute."""

    def __init__(
        self,
        robot: SimulatedRobot,
        clock: Callable[[], float],
        take: Callable[[float], None],
        compute: Callable[[], None],
    ) -> None:
        super().__init__(robot, clock, take=take)
        self._compute = compute

    def write(self, address: int, data: bytes) -> None:
        """See `I2CBus`."""
        self._compute()
        super().write(address, data)

    def read(self, address: int, count: int) -> bytes:
        """See `I2CBus`."""
        self._compute()
        return super().read(address, count)

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        """See `I2CBus`."""
        self._compute()
        return super().write_read(address, data, count)


class TimedRobot:
    """See the module."""

    def __init__(self, *, scl: float, cpu: float, seed: int = 1) -> None:
        """`scl` in Hz; `cpu` is the CPU time of a tick in s."""
        model, noise = body_model("zero2w", Body()), random.Random(seed)
        self.now = self.deadline = 100.0
        self.body = BalboaBody(model, self.now)
        self.robot = SimulatedRobot(self.body, noise, errors=draw_errors(noise))
        self.robot.scl = scl
        self.bus = ComputingBus(self.robot, self.clock, self._take, self._compute)
        self.balancer = Balancer(self.bus, model, 0.0, self.clock, self.bus.pause, start_mode="stand")
        self.tasks = SlackTasks(self.balancer, self.clock)
        self.news: list[LoopMessage] = []
        self.missed = 0
        self.step_max = 0.0
        self.behind: set[str] = set()
        self._cpu = cpu
        self._cpu_parts = 0
        self._polls: list[int] = []
        self._tick = self._answers = 0

    def clock(self) -> float:
        """Seconds of virtual time."""
        return self.now

    def run(self, seconds: float) -> None:
        """Tick for so long; ticks that a long one runs into are left out, as in the loop."""
        end = self.deadline + seconds
        while self.deadline < end - PERIOD_S / 2:
            self._run_tick()

    def stand(self) -> None:
        """Run until it balances, or for `WARM_UP_S`."""
        end = self.deadline + WARM_UP_S
        while self.balancer.mode != "balancing" and self.deadline < end:
            self._run_tick()

    def measure(self, seconds: float) -> TimedResult:
        """Let it stand up, then balance with a button pressed and two lines of the display changed now and then."""
        self.stand()
        self.tasks.obey(ScreenText(("r0", "balancing")), self.now)
        self.run(2.0)
        self.news.clear()
        self.missed, self.step_max = 0, 0.0
        self.behind.clear()
        pressed, screen_s, begun = 0, None, self.now
        self.tasks.obey(ScreenText(("r0", "balancing 7.4 V", "", "consensus k=12")), self.now)
        for _ in range(round(seconds / PERIOD_S / (2 * PRESS_TICKS))):
            self.robot.atmega.press(1)
            self.run(PRESS_TICKS * PERIOD_S)
            self.robot.atmega.press(0)
            self.run(PRESS_TICKS * PERIOD_S)
            pressed += 1
            if screen_s is None and any(isinstance(each, Display) and len(each.lines) > 2 for each in self.news):
                screen_s = self.now - begun
        took = self.now - begun
        buttons = [each.presses_a for each in self.news if isinstance(each, Buttons)]
        sequences = {each.sequence for each in self.news if isinstance(each, Uwb) and each.ranges}
        return TimedResult(
            upright=self.balancer.mode == "balancing",
            missed=self.missed,
            uwb=len(sequences) / took,
            battery=sum(isinstance(each, Battery) for each in self.news) / took,
            presses=(max(buttons, default=0) - min(buttons, default=0) + (1 if buttons else 0)) / max(1, pressed),
            screen_s=screen_s,
            step_max=self.step_max,
            behind=frozenset(self.behind),
        )

    def _run_tick(self) -> None:
        self.now = max(self.now, self.deadline)
        self._cpu_parts = CPU_PARTS
        begun = self.now
        self.balancer.step(self.now)
        self.step_max = max(self.step_max, self.now - begun)
        self.now += self._cpu_parts * self._cpu / CPU_PARTS
        self._cpu_parts = 0
        self.deadline += PERIOD_S
        self.balancer.show_leds(self.now)
        self.news += self.tasks.run(self.deadline)
        self.behind |= set(filter(None, self.tasks.behind.split(", ")))
        self._answer()
        self._tick += 1
        if self.now > self.deadline:
            skipped = int((self.now - self.deadline) / PERIOD_S) + 1
            self.missed += skipped
            self.deadline += skipped * PERIOD_S

    def _take(self, seconds: float) -> None:
        self.now += seconds

    def _compute(self) -> None:
        if self._cpu_parts > 1:
            self._cpu_parts -= 1
            self.now += self._cpu / CPU_PARTS

    def _answer(self) -> None:
        """What the UWB module says to the ATmega's polls, each a report of its own."""
        line = self.robot.atmega.line
        if line.to_send() == LOC_GET.request:
            self._polls.append(self._tick + ANSWER_TICKS)
        if self._polls and self._tick >= self._polls[0]:
            del self._polls[0]
            self._answers += 1
            line.receive(encode_location(location(self._answers)), self.now)


def location(number: int) -> Location:
    """A report of four anchors in which every distance tells its `number`."""
    away = number % 1000 / 1000
    anchors = (AnchorRange(f"C93{n}", n + away, 90, Position(float(n), 1.0, 0.0, 100)) for n in range(4))
    return Location(Position(away, 2.0, 0.1, 90), tuple(anchors))
