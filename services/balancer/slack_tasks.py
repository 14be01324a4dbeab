"""The use of the bus in the slack of the ticks: battery, buttons, UWB reports, requests to the DWM1001, the IMU's
rates.

Each task is a core that says which transfer is next. This runs them as far as the rest of the tick allows: by what
transfers were seen to take on this bus, one that does not fit is made shorter or waits, so that no control step is ever
late because of one. A task that has waited for longer than its patience goes before more important ones. Where a tick
has little time left, UWB and battery are read along with the encoders, which costs no transfer of their own. A task for
which there was no time at all for two seconds is named in `balancer/state`.
"""

import errno
import logging
from collections.abc import Callable, Sequence

from services.balancer.balancer import Balancer
from services.balancer.bridge.link import LoopMessage
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices import balboa, imu
from services.balancer.core.devices.buttons import ButtonCounter
from services.balancer.core.devices.display import ADDRESS, Screen, ScreenText
from services.balancer.core.devices.health import BoardHealth
from services.balancer.core.devices.mailbox import Mailbox
from services.balancer.core.devices.rates import RateMeter
from services.balancer.core.devices.tune import Player
from services.balancer.core.devices.uwb import UwbReader
from services.balancer.core.slack.queue import STARVED_S, QueuedTask, by_urgency
from services.balancer.core.slack.transfers import SlackTask
from services.balancer.core.slack.wire_time import Room, Transfer, TypicalTime
from swarm.errors import RemoteError
from swarm.messages import Display, ImuRequest, ImuSample, MeasureI2C, ModuleRequest, SetNotes

SLACK_S = 4.4e-3
"""Bus time of a tick for all slack tasks, s: the longest transfer (32 bytes from the ATmega, 4.2 ms at 100 kHz) and no
second one. With the control step's 3.5 ms the bus is busy for 8 of 10 ms at most."""
MARGIN_S = 0.6e-3
"""Time that stays free before the next tick, s. For a task without a transfer for two seconds it is
STARVED_MARGIN_S."""
STARVED_MARGIN_S = 0.1e-3
READ_ALONE = 12
"""If a read of so many bytes fits the slack, UWB and battery are read there and do not delay the motors."""
ALONG = 16
"""The most bytes read along with the encoders. They delay the motor command by up to 1.8 ms at 100 kHz."""
BEHIND_S = 10.0
"""Seconds for which a task counts as behind after it had no time, whatever it transfers meanwhile."""
LOG_PERIOD_S = 10.0
"""Seconds between two log lines about failures: repeated ones are only counted."""

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
        self._meter = RateMeter()
        self._along = QueuedTask("uwb", self._uwb, 0.05), QueuedTask("battery", self._health, 0.5)
        """The tasks that can be read along with the encoders."""
        self._measured = QueuedTask("measure", self._meter, 1.0)
        self._queue = (
            QueuedTask("notes", self._player, 0.05),
            self._along[0],
            QueuedTask("module", self._mailbox, 0.1),
            self._along[1],
            QueuedTask("display", self._screen, 0.3),
            self._measured,
        )
        """The most important task first (docs/reference/robot/i2c-bus.md)."""
        self._boarded: QueuedTask | None = None
        """The task whose transfer is under way with the control step."""
        self._before = 0
        """Bytes of it before those that it wanted."""
        self._mark = 0
        """The offset up to which something was read along last; 0 where that is not known."""
        self._until = now
        """The time at which the next tick begins."""
        self._begun: float | None = None
        """The time at which this tick began, by the bus' own count of time."""
        self._planned = 0.0
        """Planned duration of the tick's transfers besides those of the control step, s."""
        self._busy = TypicalTime(PERIOD_S)
        """Duration of the rest of a tick: the control step and computation."""
        self.behind = ""
        """Tasks for which the bus has no time, by name; empty where it has time for all."""
        self._lines: tuple[str, ...] = ()
        self._shown: tuple[bool, tuple[str, ...]] | None = None
        """The state of the display that was published last."""
        self._buttons = ButtonCounter()
        self._imu_until = self._imu_next = now
        self._imu_period = 0.0
        self._imu_sequence = 0
        self._was_connected = False
        self._logged = now - LOG_PERIOD_S
        self.errors = 0
        """Transfers that failed here since the start."""
        balancer.passenger = self

    def obey(self, message: LoopMessage, now: float) -> bool:
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

    def board(self, now: float) -> tuple[int, int]:
        """Return the read that goes along with the control step, as `Passenger` has it: UWB or battery, where the time
        after the step is too short for a transfer of its own."""
        self._begun, self._planned = self._spent(), 0.0
        if self._boarded is not None:  # the step before failed
            self._boarded, self._mark = None, 0
        wire, nothing = self._balancer.wire, (balboa.ENCODERS, 0)
        next_tick = self._until + PERIOD_S
        left = next_tick - MARGIN_S - now - self._busy.seconds
        if wire.room(left).read >= READ_ALONE or self._leds_change(next_tick):
            return nothing
        for queued in sorted(by_urgency(self._queue, now), key=lambda each: not self._goes_on(each, now)):
            room = left + self._granted(queued, now)
            if queued not in self._along:
                if queued.urgency(now) and self._fits(queued, now, room):
                    return nothing  # it is to have what is left of this tick
                continue
            fits = min(ALONG, int(room / wire.byte_s))
            if (transfer := queued.task.next(now, Room(fits, 0, 0))) is None:
                queued.idle()
                continue
            queued.wants(now)
            if (boarded := self._board(queued, transfer, fits)) is not None:
                return boarded
        return nothing

    def _goes_on(self, queued: QueuedTask, now: float) -> bool:
        """Return whether what a task wants begins where the last read ended: the cheapest there is, and soon done."""
        if queued not in self._along or self._mark == 0:
            return False
        transfer = queued.task.next(now, Room(1, 0, 0))
        return transfer is not None and transfer.data[0] == self._mark

    def _leds_change(self, until: float) -> bool:
        """Return whether LEDs are to be written in this tick: there is time for no more then."""
        return self._balancer.led_claim.next_change < until or self._balancer.leds_wanted(until) is not None

    def _granted(self, queued: QueuedTask, now: float) -> float:
        """Return how much of the margin a task may use, s."""
        return MARGIN_S - STARVED_MARGIN_S if queued.waited(now) >= STARVED_S else 0.0

    def _fits(self, queued: QueuedTask, now: float, seconds: float) -> bool:
        transfer = queued.task.next(now, self._balancer.wire.room(seconds))
        return transfer is not None and self._balancer.wire.duration(transfer) <= seconds

    def _board(self, queued: QueuedTask, transfer: Transfer, fits: int) -> tuple[int, int] | None:
        """Index and bytes for a transfer: on from the last one, or from a multiple of 4 at or before it. None where
        none of its bytes fits."""
        offset = transfer.data[0]
        self._before = 0 if offset == self._mark else offset - min(offset & ~3, balboa.LAST_JOINED)
        if self._before >= fits:
            return None
        count = min(transfer.reads + self._before, fits)
        index = balboa.ONWARD if offset == self._mark else balboa.joined(offset - self._before)
        self._boarded, self._planned = queued, count * self._balancer.wire.byte_s
        self._mark = offset - self._before + count
        return index, count

    def alight(self, data: bytes, now: float) -> None:
        assert self._boarded is not None
        queued, self._boarded = self._boarded, None
        self._taken(queued, data[self._before :], now)

    def run(self, until: float, stop: float | None = None) -> Sequence[LoopMessage]:
        """Do what fits before `until`, the next tick's time, and before `stop`. Returns what is to be told."""
        now = self._clock()
        news: list[LoopMessage] = []
        balancer = self._balancer
        self._until = until
        if not balancer.connected:
            self._was_connected = False
            self._begun = None
            self._mailbox.expire(now)
        else:
            if not self._was_connected:
                self._was_connected = True
                self._uwb.restart()
            self._uwb.notice(balancer.motion.newest_report)
            end = until - MARGIN_S if stop is None else min(stop, until - MARGIN_S)
            self._work(min(SLACK_S, end - now))
            if (buttons := self._buttons.update(balancer.motion.buttons, now)) is not None:
                news.append(buttons)
            if self._imu_next <= now < self._imu_until:
                news.append(self._sample(now))
            self._judge(now)
        if self._health.overdue(now):
            balancer.battery = None
        elif self._health.found is not None:
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
        if self._begun is not None:
            self._busy.add(max(1e-5, self._spent() - self._begun - self._planned))
            self._begun = None
        return news

    def _work(self, budget: float) -> None:
        """Transfers of `budget` seconds at most."""
        wire = self._balancer.wire
        for queued in by_urgency(self._queue, self._clock()):
            if queued is self._measured and self._mailbox.active:
                continue
            granted = self._granted(queued, self._clock())
            while (transfer := queued.task.next(now := self._clock(), wire.room(budget + granted))) is not None:
                queued.wants(now)
                cost = wire.duration(transfer)
                if cost > budget + granted:
                    break
                budget -= cost
                granted = 0.0
                self._planned += cost
                self._transfer(queued, transfer, now)
                if queued is self._measured:
                    break
            else:
                queued.idle()

    def _transfer(self, queued: QueuedTask, transfer: Transfer, now: float) -> None:
        if queued is self._measured:
            queued.served(now)
            self._measure(transfer, now)
            return
        try:
            data = self._balancer.balboa.transfer(transfer)
        except OSError as error:
            queued.served(now)
            self._failed(queued.task, error, now)
        else:
            self._taken(queued, data, now)

    def _taken(self, queued: QueuedTask, data: bytes, now: float) -> None:
        queued.served(now)
        try:
            queued.task.take(data, now)
        except RemoteError as error:
            self._failed(queued.task, OSError(errno.EBADMSG, str(error)), now)

    def _judge(self, now: float) -> None:
        """Name the tasks for which there is no time, and tell when that changes."""
        if self._meter.active and self._measured.waited(now) >= STARVED_S:
            self._meter.give_up(now, "the bus has no time for so many bytes in a tick: measure fewer (--sizes 1,4)")
            self._measured.idle()
        for queued in self._queue:
            slow = (queued.task is self._uwb and self._uwb.behind) or (
                queued.task is self._screen and self._screen.behind(now)
            )
            if slow or queued.waited(now) >= STARVED_S:
                queued.starved_at = now
        behind = ", ".join(each.name for each in self._queue if now < each.starved_at + BEHIND_S)
        if behind != self.behind:
            self.behind = behind
            clock = f"SCL {1e-3 * self._balancer.wire.scl:.0f} kHz"
            see = "see docs/reference/robot/i2c-bus.md"
            text = f"no time for {behind} ({clock}): {see}" if behind else f"time for all tasks ({clock})"
            _log.warning("I2C: %s", text)
            self._balancer.notices.append(("i2c", text))

    def _spent(self) -> float:
        """Return the clock, with what a simulated bus counts instead of taking it."""
        return self._clock() + self._balancer.bus.untimed()

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
        """Return the display's state to publish, once it is drawn or known to be absent."""
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
