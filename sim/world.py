"""The one world of a run: true poses, LEDs as they shine, and the UWB modules that range in it.

Bodies integrate their own motion (in the balancer's loop, on its clock) and report their true poses here; whatever
depends on more than one robot is decided here.
"""

import contextlib
import logging
import os
import select
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from sim.control import datagrams
from sim.core.actions import BODY_SOCKET, BodyPlace, SimulationAction, pack
from sim.core.contacts import Contacts
from sim.core.module_line import SOURCE as SOURCE_ATMEGA
from sim.core.scene_record import SceneRecord
from sim.devices.module import ModuleBoard
from sim.scene import contacts_of
from swarm import clock
from swarm.config import Config
from swarm.frozen import frozen
from swarm.messages import LedChange, Target, Truth
from swarm.messages.codec import MAX_PAYLOAD, decode_any
from swarm.messages.sim import TRUTH_PERIOD_S
from swarm.process.paths import socket_path

_log = logging.getLogger("sim")

SOCKET = "world.sock"

T = TypeVar("T")


@frozen
class BodyReport:
    """A simulated body's report of its true pose, in m and rad."""

    robot: str
    t: float
    x: float
    y: float
    heading: float
    tilt: float
    held: bool
    """Whether the robot is in the hand that holds it at the start."""
    speed: float = 0.0
    """Speed of the axle, forward, m/s."""


@frozen
class BodyHello:
    """A simulated body's first message, to learn where it had been."""

    robot: str


@frozen
class LedReport:
    """A simulated body's report that its LEDs have changed."""

    robot: str
    t: float
    red: bool
    yellow: bool
    green: bool


Report = BodyReport | LedReport | BodyHello
_KINDS: tuple[type[Report], ...] = (BodyReport, LedReport, BodyHello)
"""The types of all messages that simulated bodies send."""


class BodyWorld:
    """Owns the true poses; works in a thread of its own until closed."""

    def __init__(
        self, run_dir: Path, config: Config, seed: int, publish: Callable[[str, Truth | Target | LedChange], None]
    ) -> None:
        """`publish(robot, message)` is called from the world's thread: 10 times a second with each robot's truth (and
        that of a target that moves), and whenever its LEDs have changed."""
        self._simulation = config.simulation
        self._publish = publish
        self._publish_at = dict.fromkeys(config.names, 0.0)
        self._run_dir = run_dir
        self._starts = config.simulation.places
        self._last: dict[str, BodyReport] = {}
        self._socket = datagrams.receiver(run_dir, SOCKET)
        self._modules = ModuleBoard(run_dir, config, seed)
        self._ranging = config.dwm.source.startswith("serial:") or config.dwm.source == SOURCE_ATMEGA
        if self._ranging:
            for name in config.names:
                self._modules.add(name)
        self._wake = os.eventfd(0, os.EFD_CLOEXEC)
        self._scene_record = SceneRecord(config.names)
        self._contacts = contacts_of(config)
        self._seeing = threading.Lock()
        self._closing = False
        self.problem = ""
        """Why the world stands still, in words; empty while it goes on."""
        self._thread = threading.Thread(target=self._run, name="world", daemon=True)
        self._thread.start()

    def move_target(self, since: float) -> None:
        """Let the target move from this time on, if the configuration gives it a velocity."""
        self._modules.moves_from = since

    def close(self) -> None:
        """Stop the world and unplug the modules."""
        self._closing = True
        os.eventfd_write(self._wake, 1)
        self._thread.join()
        self._modules.close()
        self._socket.close()
        os.close(self._wake)

    def look(self, at: Callable[[SceneRecord, Contacts], T]) -> T:
        """Return `at(scene_record, contacts)`, called while nothing new is seen."""
        with self._seeing:
            return at(self._scene_record, self._contacts)

    def _run(self) -> None:
        """Work until closed. A defect ends the world: what it knows may be half changed."""
        try:
            self._work()
        except Exception as error:  # noqa: BLE001 - whatever it is, the run must say so
            _log.exception("the world has a defect")
            self.problem = f"defect of the world: {error!r}"

    def _work(self) -> None:
        while not self._closing:
            timeout = min(1.0, max(0.0, self._modules.next_deadline() - clock.now()))
            sources: list[int | socket.socket | ModuleBoard] = [self._wake, self._socket, self._modules]
            readable, _, _ = select.select(sources, [], [], timeout)
            if self._socket in readable:
                self._take_reports()
            self._modules.poll(0.0)

    def _take_reports(self) -> None:
        for datagram, _ in datagrams.received(self._socket, MAX_PAYLOAD):
            report = decode_any(_KINDS, datagram, SOCKET)
            if report is None or report.robot not in self._publish_at:
                continue  # only our own bodies write here; a torn datagram cannot happen
            if isinstance(report, BodyReport):
                self._place(report)
            elif isinstance(report, LedReport):
                self._show(report)
            else:
                self._answer(report.robot)

    def _show(self, leds: LedReport) -> None:
        """Pass on what a robot's LEDs show."""
        with self._seeing:
            self._scene_record.leds(leds.robot, leds.t, yellow=leds.yellow)
        self._publish(leds.robot, LedChange(leds.t, leds.red, leds.yellow, leds.green))

    def _answer(self, robot: str) -> None:
        """Tell a body that starts where it had been: it fell over there when its process ended."""
        last = self._last.get(robot)
        start = self._starts.get(robot, (0.0, 0.0, 0.0))
        place = (
            BodyPlace(*start, 0.0, True)
            if last is None
            else BodyPlace(last.x, last.y, last.heading, last.tilt, last.held)
        )
        self._act(robot, place)

    def _act(self, robot: str, act: SimulationAction) -> None:
        with contextlib.suppress(OSError):  # the body's process has ended
            self._socket.sendto(pack(act), str(socket_path(self._run_dir / robot, BODY_SOCKET)))

    def _place(self, report: BodyReport) -> None:
        self._last[report.robot] = report
        robot, t, place = report.robot, report.t, (report.x, report.y)
        with self._seeing:
            self._scene_record.pose(robot, t, place, report.tilt)
            hits = self._contacts.pose(robot, t, place, report.heading, report.speed, report.tilt, held=report.held)
        for hit in hits:
            self._act(hit.robot, hit.knock(self._last[hit.robot].heading))
        if self._ranging:
            self._modules.update_pose(report.robot, report.x, report.y, report.heading)
        due = self._publish_at[report.robot]
        if report.t >= due:
            # From when it was due, not from now: reports come every 40 ms, and 100 is no multiple of that.
            self._publish_at[report.robot] = max(due + TRUTH_PERIOD_S, report.t)
            self._publish(report.robot, Truth(report.t, report.x, report.y, report.heading, report.tilt))
            if self._simulation.moving:
                target = self._simulation.target_after(report.t - self._modules.moves_from)
                self._publish(report.robot, Target(report.t, *target))
