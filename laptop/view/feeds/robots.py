"""Real robots: some through ssh at their full rate, all others over the mesh, as those are told (`mesh/view`)."""

import logging
import threading
from collections.abc import Sequence
from functools import partial

from laptop.fleet.ssh.ssh import Host, HostError, Ssh
from laptop.view.feeds.feed import RealTimeFeed
from laptop.view.feeds.news import REACH
from laptop.view.feeds.tunnel import Tunnel
from swarm import clock
from swarm.config.types import Config
from swarm.errors import LocalError, PayloadError
from swarm.messages import View, Watch
from swarm.messages.codec import decode
from swarm.messages.keys import key, parse, whose_token

WATCH_S, WATCH_EVERY_S = 15.0, 5.0
"""Seconds for which other robots are asked to report, and between two requests: two requests may be lost."""

SEEK_EVERY_S = 2.0
"""Seconds between two requests while some robots are not visible."""

SILENT_S = 4.0
"""Seconds without a message after which a robot with an ssh connection counts as silent. A robot sends something each
second."""

VIEW_SILENT_S = 5.0
SHARE_S = 0.8
"""Seconds without a message over the mesh after which a robot counts as silent, and the seconds that each robot of the
swarm adds: large swarms report less often."""

GRACE_S = 5.0
"""Seconds after the start before a robot counts as out of reach if the mesh has carried nothing of it."""

BY_SSH, BY_MESH = "ssh", "mesh"

_log = logging.getLogger("view")

_LOST = {"gone": "the mesh has lost it", "left": "its mesh was stopped"}
_LOOK_EVERY_S = 0.25
_FIRST_S = 20.0
"""Seconds that the first connection may take; ssh gives up a robot that does not answer after 10."""


class Robots(RealTimeFeed):
    """Watches real robots until closed."""

    kind = "robots"

    def __init__(self, config: Config, hosts: Sequence[Host], ssh: Ssh) -> None:
        """`hosts`: the robots to connect to; one is enough to see all. Raises `HostError` where none can be reached."""
        super().__init__()
        self.config = config
        self._turn = threading.Event()
        self._closing = False
        self._bus: dict[str, bool] = {}
        self._stranger: dict[str, str] = {}
        self._heard: dict[str, float] = {}
        self._viewed: dict[str, float] = {}
        self._watched_at = -WATCH_EVERY_S
        self.buses = {host.robot: Tunnel(ssh, host, partial(self._take, host.robot), self._turn.set) for host in hosts}
        """The connection to each robot that has one."""
        try:
            self._wait()
        except HostError:
            for tunnel in self.buses.values():
                tunnel.close()
            raise
        self._thread = threading.Thread(target=self._look, name="feed", daemon=True)
        self._thread.start()

    @property
    def live(self) -> bool:
        """Return whether any robot is reached by ssh."""
        return any(tunnel.connected for tunnel in self.buses.values())

    def check_control(self) -> None:
        """Raise `LocalError` where no robot can be told anything at this moment."""
        if not self.live:
            raise LocalError("no robot is reached by ssh: `swarm estop` tries every way there is")

    def close(self) -> None:
        self._closing = True
        self._turn.set()
        self._thread.join()
        for tunnel in self.buses.values():
            tunnel.close()

    def _wait(self) -> None:
        """Wait until the first robot is heard."""
        end = clock.now() + _FIRST_S
        while not self.live:
            problems = [f"{name}: {tunnel.problem}" for name, tunnel in self.buses.items() if tunnel.problem]
            if len(problems) == len(self.buses) or clock.now() > end:
                raise HostError("; ".join(problems) or f"no answer within {_FIRST_S:g} s")
            self._turn.wait(_LOOK_EVERY_S)
            self._turn.clear()

    def _look(self) -> None:
        while not self._closing:
            try:
                self._look_once(clock.now())
            except Exception:  # noqa: BLE001 - a defect here; the next look may do better
                _log.exception("a look at the robots has failed")
            self._turn.wait(_LOOK_EVERY_S)
            self._turn.clear()

    def _look_once(self, now: float) -> None:
        """Ask for views where it is time, and find out how each robot is seen."""
        seen = self._bus.keys() | self._viewed.keys()
        every = WATCH_EVERY_S if seen >= set(self.config.names) else SEEK_EVERY_S
        if now >= self._watched_at + every and (viewpoint := self._viewpoint()) is not None:
            self._watched_at = now
            self.buses[viewpoint].publish(key(viewpoint, "mesh", "set", "watch"), Watch(now, WATCH_S))
        with self.lock:
            for name in self.config.names:
                by, why = self._reach(name, now)
                if by is None and now < self.began + GRACE_S and name not in self.buses:
                    continue
                before = self.picture.newest(name, REACH)
                value: dict[str, object] = {"by": by, "why": why}
                if before != value:
                    self.picture.put(name, REACH, value, now - self.began)

    def _viewpoint(self) -> str | None:
        """Return the robot through which the others are seen."""
        return next((name for name, tunnel in self.buses.items() if tunnel.connected), None)

    def _reach(self, name: str, now: float) -> tuple[str | None, str]:
        """Return how a robot is seen at this moment, and why not."""
        why, tunnel = "", self.buses.get(name)
        if tunnel is not None:
            if stranger := self._stranger.get(name):
                why = f"that host is {stranger}: which `host` has {name} in {self.config.path.name}?"
            elif not tunnel.connected:
                why = tunnel.problem
            elif not self._bus.get(name, True):
                why = "it has no bus: swarm services start bus"
            elif now < self._heard.get(name, self.began) + SILENT_S:
                return BY_SSH, ""
            else:
                why = "its services say nothing"
        if not self.live:
            return None, why or "no robot is reached by ssh"
        if gone := self._gone(name):
            return None, why or gone
        if now < self._viewed.get(name, -VIEW_SILENT_S) + VIEW_SILENT_S + SHARE_S * len(self.config.names):
            return BY_MESH, why
        return None, why or "the mesh brings nothing of it"

    def _gone(self, name: str) -> str:
        """Return why the mesh of the robot that shows all others does not have this robot; empty where it has."""
        viewpoint = self._viewpoint()
        members = self.picture.newest(viewpoint, "mesh/members") if viewpoint is not None else None
        for member in members.get("members") or () if isinstance(members, dict) else ():
            if isinstance(member, dict) and member.get("robot") == name:
                return _LOST.get(str(member.get("state")), "")
        return ""

    # -- what robots say, in the threads of the tunnels --------------------------------------------------------

    def _take(self, robot: str, said: list[object]) -> None:
        now = clock.now()
        with self.lock:
            match said:
                case ["bus", bool(there)]:
                    self._bus[robot] = there
                    self._stranger.pop(robot, None)
                case ["key", str(name), bytes(payload)]:
                    self._sample(robot, name, payload, now)
                case ["alive", str(name), bool(there)]:
                    self._alive(robot, name, there, now)
                case ["passed", str(sender), int(count)]:
                    if sender in self.config.names:
                        self.picture.passed(sender, robot, count)
                case _:
                    self.picture.refuse(robot, "a message of its lookout", "is its release another one?")

    def _sample(self, bus: str, name: str, payload: bytes, now: float) -> None:
        try:
            robot, service, topic = parse(name)
        except PayloadError:
            self.picture.refused += 1
            return
        if robot not in self.config.names:
            return
        if robot == bus:
            self._heard[robot] = now
        elif self._speaks_for_itself(robot):
            return  # on another bus somebody might say that this robot has stopped
        elif (service, topic) == ("mesh", "view"):
            self._view(robot, name, payload, now)
            return
        self.picture.take("", name, payload, now - self.began)

    def _speaks_for_itself(self, robot: str) -> bool:
        """Return whether a robot's own bus is heard."""
        tunnel = self.buses.get(robot)
        return tunnel is not None and tunnel.connected and self._bus.get(robot, True)

    def _view(self, robot: str, name: str, payload: bytes, now: float) -> None:
        """Take another robot's report of itself, as if it had been heard on its own bus."""
        try:
            view = decode(View, payload, name)
            services = {name: whose_token(f"swarm/{robot}/{name}/alive")[1] for name in view.services}
        except PayloadError as error:
            self.picture.refuse(robot, "mesh/view", error)
            return
        self._viewed[robot] = now
        for topic, data in view.values.items():
            self.picture.take("", f"swarm/{robot}/{topic}", data, now - self.began)
        for name, text in view.services.items():
            service, (state, _, reason) = services[name], text.partition(": ")
            self.picture.alive(robot, service, state != "gone", now - self.began)
            if state not in ("gone", "here"):
                self.picture.put(robot, f"{service}/status", {"state": state, "reason": reason}, now - self.began)

    def _alive(self, bus: str, name: str, there: bool, now: float) -> None:
        try:
            robot, service = whose_token(name)
        except PayloadError:
            return
        if robot != bus:
            self._stranger[bus] = robot
        else:
            self.picture.alive(robot, service, there, now - self.began)
