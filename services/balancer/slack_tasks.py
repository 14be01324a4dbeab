"""What the bus does in the slack of the ticks: battery, buttons, UWB reports, requests to the DWM1001, the IMU's rates.

Each task is a core that says which transfer is next. This runs them, in the order of their urgency, as far as the
rest of the tick allows: a transfer that does not fit waits for the next tick, so that no control step is ever late
because of one.
"""

import errno
import logging
from collections.abc import Callable, Sequence

from services.balancer.balancer import Balancer
from services.balancer.core import imu
from services.balancer.core.balboa import PAUSE_S
from services.balancer.core.buttons import ButtonCounter
from services.balancer.core.display import ADDRESS, Screen, ScreenText
from services.balancer.core.health import BoardHealth
from services.balancer.core.mailbox import Mailbox
from services.balancer.core.rates import RateMeter
from services.balancer.core.transfers import SlackTask, Transfer, duration
from services.balancer.core.tune import Player
from services.balancer.core.uwb import UwbReader
from services.balancer.link import Message
from swarm.errors import RemoteError
from swarm.messages import Display, ImuRequest, ImuSample, MeasureI2C, ModuleRequest, SetNotes

SLACK_S = 4.4e-3
"""Of bus time a tick may spend here: the longest slice (32 bytes from the ATmega, 4.2 ms) and no second one. With the
control step's 3.5 ms the bus is busy for 8 of 10 ms at most."""
MARGIN_S = 1.0e-3
"""Left free before the next tick."""
LOG_PERIOD_S = 10.0
"""Of failures: a task that fails again and again is counted, not logged each time."""

_log = logging.getLogger("balancer")


class SlackTasks:
    """See the module. All of it runs on the loop's thread."""

    def __init__(self, balancer: Balancer, clock: Callable[[], float]) -> None:
        self._balancer, self._clock = balancer, clock
        now = clock()
        self._uwb = UwbReader(now)
        self._mailbox = Mailbox()
        self._health = BoardHealth(now)
        self._player = Player()
        self._screen = Screen(now)
        self._order: tuple[SlackTask, ...] = (self._player, self._uwb, self._mailbox, self._health, self._screen)
        self._meter = RateMeter()
        self._lines: tuple[str, ...] = ()
        self._shown: tuple[bool, tuple[str, ...]] | None = None
        """What was told of the display."""
        self._buttons = ButtonCounter()
        self._imu_until = self._imu_next = now
        self._imu_period = 0.0
        self._imu_sequence = 0
        self._was_connected = False
        self._logged = now - LOG_PERIOD_S
        self.errors = 0
        """Transfers that failed here since the start."""

    def obey(self, message: Message, now: float) -> bool:
        """Take a command; False where it is none for a task."""
        match message:
            case ModuleRequest():
                self._mailbox.post(message, now)
            case ImuRequest(rate, seconds):
                self._imu_period, self._imu_until, self._imu_next = 1.0 / rate, now + seconds, now
            case SetNotes():
                self._player.play(message, now)
            case MeasureI2C():
                self._meter.measure(message)
            case ScreenText(lines):
                self._lines = lines
                self._screen.show(lines)
            case _:
                return False
        return True

    def run(self, until: float) -> Sequence[Message]:
        """Do what fits before `until`, the next tick's time. Returns what is to be told, in order."""
        now = self._clock()
        news: list[Message] = []
        balancer = self._balancer
        if not balancer.connected:
            self._was_connected = False
            self._mailbox.expire(now)
        else:
            if not self._was_connected:
                self._was_connected = True
                self._uwb.restart()
            self._work(min(SLACK_S, until - MARGIN_S - now))
            if (buttons := self._buttons.update(balancer.motion.buttons, now)) is not None:
                news.append(buttons)
            if self._imu_next <= now < self._imu_until:
                news.append(self._sample(now))
        if self._health.found is not None:
            balancer.battery = self._health.found.battery
        for remark in self._health.remarks:
            _log.warning("%s", remark)
            balancer.notices.append(("board", remark))
        self._health.remarks.clear()
        if (display := self._display(now)) is not None:
            news.append(display)
        for task in (self._health, self._uwb, self._mailbox, self._meter):
            if task.news is not None:
                news.append(task.news)
                task.news = None
        return news

    def _work(self, budget: float) -> None:
        """Transfers of `budget` seconds at most."""
        for task in self._order:
            while (transfer := task.next(now := self._clock())) is not None:
                cost = duration(transfer)
                if cost > budget:
                    break
                budget -= cost
                try:
                    task.take(self._balancer.balboa.transfer(transfer), now)
                except OSError as error:
                    self._failed(task, error, now)
                except RemoteError as error:
                    self._failed(task, OSError(errno.EBADMSG, str(error)), now)
        transfer = None if self._mailbox.active else self._meter.next(now := self._clock())
        if transfer is not None and duration(transfer) + PAUSE_S <= budget:
            self._measure(transfer, now)

    def _measure(self, transfer: Transfer, now: float) -> None:
        """Like any transfer, but timed until the next one may begin."""
        balboa, bus = self._balancer.balboa, self._balancer.bus
        balboa.settle()
        begun = self._clock() + bus.untimed()
        try:
            data = balboa.transfer(transfer)
        except OSError as error:
            self._failed(self._meter, error, now)
            return
        balboa.settle()
        self._meter.timed(self._clock() + bus.untimed() - begun)
        self._meter.take(data, now)

    def _failed(self, task: SlackTask, error: OSError, now: float) -> None:
        if task is not self._screen or self._screen.present:  # a robot without a display is a whole robot
            self.errors += 1
            if now - self._logged >= LOG_PERIOD_S:
                self._logged = now
                _log.warning("%s: %s errors=%d", type(task).__name__, error.strerror or error, self.errors)
        task.fail(error, now)

    def _display(self, now: float) -> Display | None:
        """What is to be told of the display, once it is drawn or known not to be there."""
        screen = self._screen
        if screen.present is None or (screen.present and not screen.drawn):
            return None
        shown = (screen.present, self._lines)
        if shown == self._shown:
            return None
        if self._shown is None or self._shown[0] != screen.present:
            text = "found" if screen.present else f"not there (0x{ADDRESS:02X}): nothing is shown"
            _log.info("display %s", text)
            self._balancer.notices.append(("display", text))
        self._shown = shown
        return Display(now, *shown)

    def _sample(self, now: float) -> ImuSample:
        self._imu_next = max(self._imu_next + self._imu_period, now)
        self._imu_sequence += 1
        rates = imu.decode_all(self._balancer.imu.block)
        estimate = self._balancer.estimate
        return ImuSample(now if estimate is None else estimate.t, self._imu_sequence, rates.gyro, rates.acceleration)
