"""The 100 Hz loop: one thread on absolute deadlines, the control step first, all else in what is left of the tick.

    wake -> stops in -> read, estimate, decide, command the motors -> commands in, telemetry out, LEDs, battery, bridge
    -> sleep

It never touches the bus (Zenoh): a second process does (`services.balancer.bridge`), joined by a socket that never
blocks. A tick that comes late works with the time that really passed; ticks that were missed are not made up for.
"""

import logging
import math
import signal
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

from services.balancer import realtime
from services.balancer.balancer import Balancer
from services.balancer.bridge.child import Bridge
from services.balancer.bridge.link import TELEMETRY_S
from services.balancer.bridge.orders import halt, moves, obey
from services.balancer.core.control.body import body_model
from services.balancer.core.control.estimation.gyro import Zero
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices import leds
from services.balancer.i2c import I2CBus, open_patiently
from services.balancer.slack_tasks import SlackTasks
from services.balancer.telemetry import Telemetry
from services.balancer.zero_file import ZeroFile
from swarm import clock
from swarm.config import Config, load, who_am_i
from swarm.core.percentile import percentile
from swarm.errors import SwarmError
from swarm.messages import BalancerState, Firmware, Leds
from swarm.process import log
from swarm.process.edges import die_with_parent, notify
from swarm.process.paths import runtime_dir

TELEMETRY_TICKS = round(TELEMETRY_S / PERIOD_S)
"""Ticks between two messages of telemetry: 25 Hz."""
SECOND_TICKS = 100
PARAMETERS_TICKS = 1000
"""Ticks between two messages with the parameters: every 10 s."""
STARTED_TICKS = 3000
"""Ticks after which the service counts as started though the robot is moved and finds no zero: 30 s."""
STOPPED_FILE = "balancer.stopped"
"""The file in the runtime directory that is there from a stop until the next command to move."""
FEED_S = 1.0
"""Seconds between two messages to systemd's watchdog; its unit is given 3 s."""

_log = logging.getLogger("balancer")


class Loop:
    """Ticks until told to stop."""

    def __init__(
        self,
        balancer: Balancer,
        telemetry: Telemetry,
        tasks: SlackTasks,
        bridge: Bridge,
        keep: Callable[[Zero, float], None] = lambda *_: None,
        keep_stopped: Callable[[bool], None] = lambda _: None,
    ) -> None:
        """`keep` is given the gyro's zero once a second, and `keep_stopped` whether a stop holds, for the
        process after this one. `keep_stopped` may raise `OSError`."""
        self._balancer = balancer
        self._keep = keep
        self._keep_stopped = keep_stopped
        self._telemetry = telemetry
        self._tasks = tasks
        self._bridge = bridge
        self._late = deque([0.0] * 100, maxlen=100)
        """By how much the ticks of the last second began late, s."""
        self._stopping = False
        self._announced = False
        self._leds_at = 0.0
        self._stopped_at = -math.inf
        self._stop_is_kept = balancer.stopped
        self._keeping_failed = ""
        self._fed_at = -math.inf
        self.ticks = 0
        self.missed = 0

    def stop(self) -> None:
        """End after the running tick; safe in a signal handler."""
        self._stopping = True

    def run(self) -> None:
        now, sleep, step = clock.now, time.sleep, self._balancer.step
        deadline = now()
        while not self._stopping:
            # time.sleep waits for an absolute time of the monotonic clock (clock_nanosleep, since Python 3.11).
            wait = deadline - now()
            if wait > 2 * PERIOD_S:  # the clock went back: no reason to sleep until it is there again
                deadline = now()
            elif wait > 0.0:
                sleep(wait)
            started = now()
            self._late.append(started - deadline)
            stopped = self._look_for_stop()
            step(started)
            self.ticks += 1
            deadline += PERIOD_S
            if stopped:
                self._remember_stop()
                if self._balancer.fault is not None:
                    _log.warning("%s", self._balancer.fault.reason)
            self._use_slack(deadline)
            behind = now() - deadline
            if behind > 0.0:
                skipped = int(behind / PERIOD_S) + 1
                self.missed += skipped
                deadline += skipped * PERIOD_S

    def _look_for_stop(self) -> bool:
        """Obey a stop before the control step, whose motor command is then zero; True where it is a new one."""
        stop = self._bridge.stop()
        if stop is None:
            return False
        # Not the time at which the tick began: it may have stood still since, and have been given commands meanwhile.
        self._stopped_at = clock.now()
        return halt(self._balancer, stop)

    def _remember_stop(self) -> None:
        """Let the process after this one know whether a stop holds. What fails is tried again each second."""
        if self._stop_is_kept == (stopped := self._balancer.stopped):
            return
        try:
            self._keep_stopped(stopped)
            self._stop_is_kept, self._keeping_failed = stopped, ""
        except OSError as error:
            if str(error) != self._keeping_failed:
                self._keeping_failed = str(error)
                _log.warning("a stop cannot be kept for a restart: %s", error)

    def _use_slack(self, until: float) -> None:
        """Do a little of the other work in the slack before the next tick, at `until`. So no tick has to do all of
        it."""
        for heard, message in self._bridge.commands():
            now = clock.now()
            if heard <= self._stopped_at and moves(message):
                self._balancer.notices.append(("stop", "refused: a command that was given before the stop is void"))
            elif not (obey(self._balancer, message, now, _log) or self._tasks.obey(message, now)):
                _log.warning("the bridge sent a %s", type(message).__name__)
        self._show_leds(clock.now())
        part = self.ticks % TELEMETRY_TICKS
        if part == 0:
            # Together: to wake the bridge costs more than what it does with a message.
            self._bridge.send(self._state())
            if (odometry := self._telemetry.odometry()) is not None:
                self._bridge.send(odometry)
        elif part == 3 and (news := self._telemetry.news()) is not None:
            self._bridge.send(news)
        elif part == 1:
            self._each_second(self.ticks % SECOND_TICKS)
        elif part == 2:
            self._feed(clock.now())
        due = self._balancer.led_claim.next_change
        write_at = leds.moment(due, until)
        for message in self._tasks.run(until, write_at):
            self._bridge.send(message)
        if write_at is not None:
            self._show_leds_at(due, write_at, until)

    def _show_leds_at(self, due: float, write_at: float, until: float) -> None:
        """Write at `write_at` the LEDs that are due at `due`, unless the next tick is too near by then."""
        now = clock.now()
        if now < write_at:
            time.sleep(write_at - now)
        elif now > until - leds.WRITE_S - leds.MARGIN_S:
            return
        self._show_leds(max(due, now))

    def _show_leds(self, now: float) -> None:
        if self._balancer.show_leds(now):
            self._leds_at = clock.now()
            self._tell_leds()

    def _each_second(self, tick: int) -> None:
        if tick == 25:
            self._bridge.keep_up(clock.now(), stopped=self._balancer.stopped)
            self._remember_stop()
        elif tick == 49:
            self._tell_again()
        elif tick == 61:
            self._balancer.watch_battery(clock.now())
        elif tick == 85:
            self._keep_zero()
        elif not self._announced and self._is_up():
            self._announced = True
            self._keep_zero()
            notify("READY=1", timeout_s=0.0)

    def _is_up(self) -> bool:
        """Return whether the service counts as started: the robot is ready, or waits for a person. systemd would end a
        service that never says so, and `install` would take its release back."""
        return self._balancer.ready or self._balancer.fault is not None or self.ticks >= STARTED_TICKS

    def _feed(self, now: float) -> None:
        """Tell systemd's watchdog each second, by the clock: a loop that is slow, on a bus that times out or a machine
        that has no time for it, does not hang."""
        if not self._fed_at <= now < self._fed_at + FEED_S:
            self._fed_at = now
            notify("WATCHDOG=1", timeout_s=0.0)

    def _keep_zero(self) -> None:
        if (zero := self._balancer.gyro_zero) is not None:
            self._keep(zero, clock.now())

    def _state(self) -> BalancerState:
        errors = self._balancer.bus_errors + self._tasks.errors
        late = percentile(self._late, 99), max(self._late)
        return self._telemetry.state(self.ticks, self.missed, errors, late, self._tasks.behind)

    def _tell_again(self) -> None:
        """Publish the state again for subscribers that came meanwhile."""
        self._tell_leds()
        if self._balancer.firmware is not None:
            self._bridge.send(Firmware(clock.now(), *self._balancer.firmware))
        if self._balancer.fault is not None:
            self._bridge.send(self._telemetry.fault())
        if self.ticks % PARAMETERS_TICKS == 49:
            self._bridge.send(self._telemetry.parameters())

    def _tell_leds(self) -> None:
        if self._balancer.leds is not None:
            self._bridge.send(Leds(self._leds_at, *self._balancer.leds))


def _keep_stopped(path: Path, stopped: bool) -> None:
    if stopped:
        path.touch()
    else:
        path.unlink(missing_ok=True)


def main(
    open_bus: Callable[[Config, str], I2CBus] = lambda _config, _robot: open_patiently(time.sleep),
    *,
    start_mode: str = "rest",
) -> None:
    """Balance until SIGTERM or SIGINT; the motors are off afterwards, however it ends.

    `open_bus(config, robot)` gives the I2C bus; `start_mode` (stand or rest) is obeyed when the gyro's zero is known.
    """
    die_with_parent()
    log.setup("balancer")
    config = load()
    robot = who_am_i(config)
    shape, settings = config.body_of(robot), config.balancing_of(robot)
    body = body_model(config.robot(robot).board, shape)
    bus = open_bus(config, robot)
    try:
        zeros, stopped_file = ZeroFile(runtime_dir()), runtime_dir() / STOPPED_FILE
        balancer = Balancer(
            bus,
            body,
            shape.trim,
            clock.now,
            bus.pause,
            start_mode=start_mode,
            settings=settings,
            kept_zero=zeros.read(clock.now()),
        )
        try:
            if stopped_file.exists():
                balancer.stop("before the balancer was started anew")
            bridge = Bridge(clock.now(), stopped=balancer.stopped)
            try:
                telemetry = Telemetry(balancer, settings.controller)
                keep_stopped = partial(_keep_stopped, stopped_file)
                loop = Loop(balancer, telemetry, SlackTasks(balancer, clock.now), bridge, zeros.keep, keep_stopped)
                for number in (signal.SIGTERM, signal.SIGINT):
                    signal.signal(number, lambda *_: loop.stop())
                realtime.enter(_log)
                try:
                    loop.run()
                except SwarmError as error:  # no wrong configuration, after which systemd would not start it again
                    raise RuntimeError(str(error)) from error
                _log.info("stopping ticks=%d missed=%d bus_errors=%d", loop.ticks, loop.missed, balancer.bus_errors)
            finally:
                balancer.motors_off()  # first of all: ending the bridge takes its time
                notify("STOPPING=1")
                bridge.close()
        finally:
            balancer.motors_off()
    finally:
        bus.close()
