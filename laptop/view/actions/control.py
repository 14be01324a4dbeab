"""The commands of a page to the swarm, where it was started with `--control`. Without that every command is refused."""

import threading
from collections import Counter
from collections.abc import Mapping
from typing import Any

from laptop.view.actions.robot_actions import PageAction, RobotActions, check_parameter, named, settings_of
from laptop.view.feeds.feed import LiveFeed, RobotBus
from swarm import clock
from swarm.app.settings import on_top
from swarm.clock import elapsed
from swarm.config.types import AppConfig
from swarm.errors import LocalError
from swarm.messages import Arm, SetAppParameters, SetMode, SetVelocity, Stop
from swarm.messages.codec import Value
from swarm.messages.keys import STOP, is_name, key
from swarm.onboard.buses.ask import new_ticket

REASON = "the page of swarm view"
DRIVE_S = 0.4
"""Seconds that a robot drives after a request. If the page hangs or is closed, the robot stops after this time."""
MAX_SPEED = 0.3
"""The fastest speed that a page may command, m/s."""
MAX_TURN = 3.0
"""The fastest turn rate that a page may command, rad/s."""
MODES = ("stand", "rest", "lie")
"""The modes that a page may command."""
ENOUGH = 5
"""Times that a robot is told of a stop before what it has said earlier counts as its answer."""
ANSWER_S = 5.0
"""Seconds for which a request to set a parameter, or the end of a stop, is repeated: the app may be starting, and a bus
may lose a request."""
START_S = 60.0
"""Seconds for which a request to an app is repeated that is started before, over ssh on a slow robot."""


class _Halt:
    """A stop for all robots, or the end of one, that not all robots have confirmed."""

    def __init__(self, stop: bool, version: int, age: float) -> None:
        """`version`: the version of the picture when the command was given; `age`: seconds since then."""
        self.stop = stop
        self._since = elapsed() - age
        self.confirmed: set[str] = set()
        """Robots that have confirmed. They are not told again: somebody else may give another command meanwhile."""
        self.overruled = False
        """Whether somebody else has given a later command: this one is not told to robots that come later."""
        self._opposed: dict[str, int | None] = {}
        """Of the confirmed robots whose buses have been there since: the version in which it first said the opposite.
        A robot that was switched off is none of them, since it has forgotten its stops when it comes back."""
        self._version = version
        self._given: Counter[str] = Counter()
        """How often each robot was told while its bus was there."""

    @property
    def age(self) -> float:
        """Return the seconds since the command was given, with those in which the laptop slept: the end of a stop must
        not take back stops that others gave meanwhile."""
        return elapsed() - self._since

    def give(self, name: str, bus: RobotBus) -> None:
        now = clock.now()
        if self.stop:
            bus.publish(STOP, Stop(now, name, REASON), urgent=True)
        else:
            bus.publish(key(name, "mesh", "set", "arm"), Arm(now, name, self.age), urgent=True)
        self._given[name] += bus.connected

    def look(self, name: str, bus: RobotBus, stopped: object, version: int) -> None:
        """Look what a robot says in the newest picture. A robot confirms by what it says afterwards, or said before
        where it was told often enough, since its news may be lost. A robot that later says the opposite twice in a row
        obeys a later command."""
        says = stopped.get("stopped") if isinstance(stopped, dict) else None
        if not bus.connected:
            self._opposed.pop(name, None)
        elif says is self.stop:
            if version > self._version or self._given[name] >= ENOUGH:
                self.confirmed.add(name)
                self._opposed[name] = None
        elif says is not None and name in self._opposed:
            first = self._opposed[name] = self._opposed[name] or version
            self.overruled = self.overruled or version > first


class Control:
    """Carries out what pages ask, in any threads."""

    def __init__(self, feed: LiveFeed, actions: RobotActions | None) -> None:
        """`actions`: what can be done besides what goes over a bus; None where the page only watches."""
        self._feed = feed
        self._actions = actions
        self._halting = threading.Lock()
        """A lock that is held while a stop, or its end, is sent. So the later of two commands is in force on every
        robot."""
        self._wanted: _Halt | None = None
        self.halt = {"number": 0, "stop": False}
        """The newest stop, or end of one: which one it is, and whether it is a stop. By it a page sees that another
        page has taken its stop back."""
        self._asked: dict[tuple[str, str], tuple[SetAppParameters, float]] = {}
        """Unanswered requests by robot and app, each with the time until which it is repeated."""
        self.acts: dict[str, PageAction] = {}
        """The actions that pages may request."""
        if actions is not None:
            self.acts |= {
                "stop": lambda _: self._halt(stop=True),
                "arm": self._arm,
                "set": self._set,
                "mode": self._mode,
                "drive": self._drive,
                **actions.acts,
                "start": self._start,
            }

    def close(self) -> None:
        """Give up what is under way."""
        if self._actions is not None:
            self._actions.close()

    def do(self, asked: object) -> str:
        """Carry out `{act: NAME, ...}`, and return in words what was done. Raises `LocalError`."""
        if not self.acts:
            raise LocalError("this page only watches: start `swarm view --control` to act")
        if not isinstance(asked, dict) or (act := self.acts.get(str(asked.get("act")))) is None:
            raise LocalError(f"expected an act of {', '.join(self.acts)}")
        try:
            return act(asked)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise LocalError(f"{asked.get('act')}: {error!r} is missing or wrong") from None
        except OSError as error:
            raise LocalError(f"{asked.get('act')}: {error.strerror or error}") from None

    def repeat(self) -> None:
        """Say again what robots have not confirmed, since a bus may lose it: a stop, the end of one, and parameters."""
        self._halt_again()
        self._ask_again()

    def _halt_again(self) -> None:
        wanted = self._wanted
        if wanted is None:
            return
        # This comes before the other lock, so that a stop does not wait for a picture that is being drawn.
        buses = self._feed.buses  # the loop below needs the same ones: a robot may leave the simulation meanwhile
        with self._feed.lock:
            for name, bus in buses.items():
                wanted.look(name, bus, *self._feed.picture.versioned(name, "mesh/stopped"))
        with self._halting:
            if self._wanted is not wanted:
                return  # a later command has gone out meanwhile
            late = [name for name in buses if name not in wanted.confirmed]
            given_up = not wanted.stop and wanted.age > ANSWER_S
            if not late or wanted.overruled or given_up:
                self._wanted = None  # a robot that comes later learns from the others that a stop was taken back
            else:
                for name in late:
                    wanted.give(name, buses[name])
        if given_up and not wanted.overruled:
            with self._feed.lock:
                for name in late:
                    if buses[name].connected:
                        text = f"has not confirmed within {ANSWER_S:g} s that the stop was taken back: arm again"
                        self._feed.picture.note(self._feed.now(), name, "warning", text)

    def _arm(self, asked: Mapping[str, Any]) -> str:
        """Take back the stops that the page showed at `t`, the time of the last step that it had been told. The request
        may have waited for this program, and others may have given stops meanwhile."""
        age = max(0.0, self._feed.now() - float(asked["t"])) if "t" in asked else 0.0
        if not age <= ANSWER_S:
            raise LocalError(f"arm: asked {age:.0f} s ago, and other stops may have come since: arm again")
        return self._halt(stop=False, age=age)

    def _halt(self, *, stop: bool, age: float = 0.0) -> str:
        self._feed.check_control()
        with self._halting:
            # The feed's lock is not held, so that a stop does not wait for a picture that is being drawn.
            self._wanted = wanted = _Halt(stop, self._feed.picture.version, age)
            self.halt = {"number": self.halt["number"] + 1, "stop": stop}
            buses = self._feed.buses
            for name, bus in buses.items():
                wanted.give(name, bus)
        if not stop:
            return "stops taken back"
        silent = [name for name, bus in buses.items() if not bus.connected]
        late = f", as yet not to {' '.join(silent)}: they are not reached" if silent else ""
        return f"stop given to all robots{late}"

    def _mode(self, asked: Mapping[str, Any]) -> str:
        """Have robots stand up, rest or lie down. Their balancers tell what comes of it."""
        mode, buses = str(asked["mode"]), self._feed.buses
        if mode not in MODES:
            raise LocalError(f"mode: expected {', '.join(MODES)}")
        robots, near = self._meant(asked)
        if not near:
            raise LocalError(f"{mode}: {asked.get('robot') or 'no robot'} is not reached")
        for robot in near:
            buses[robot].publish(key(robot, "balancer", "set", "mode"), SetMode(mode), urgent=True)
        silent = [robot for robot in robots if robot not in near]
        return f"{mode} asked of {' '.join(near)}{_except(silent)}"

    def _meant(self, asked: Mapping[str, Any]) -> tuple[list[str], list[str]]:
        """Return the robots that an act is for, the one that it names or all, and those of them whose bus is there."""
        buses, config = self._feed.buses, self._feed.config
        everybody = list(buses if config is None else config.names)
        robots = [named(asked["robot"], everybody)] if asked.get("robot") else everybody
        return robots, [robot for robot in robots if robot in buses and buses[robot].connected]

    def _drive(self, asked: Mapping[str, Any]) -> str:
        """Drive one robot for as long as a page repeats its request: without another request the robot stands within
        `DRIVE_S`."""
        robot, speed, turn = named(asked["robot"], self._feed.buses), float(asked["speed"]), float(asked["turn"])
        if not (abs(speed) <= MAX_SPEED and abs(turn) <= MAX_TURN):
            raise LocalError(
                f"drive: expected at most {MAX_SPEED:g} m/s and {MAX_TURN:g} rad/s, got {speed:g}, {turn:g}"
            )
        if not self._feed.buses[robot].connected:
            raise LocalError(f"drive: {robot} is not reached")
        message = SetVelocity(speed, turn, DRIVE_S)
        self._feed.buses[robot].publish(key(robot, "balancer", "set", "velocity"), message, urgent=True)
        return f"{robot}: {speed:g} m/s, {turn:g} rad/s"

    def _start(self, asked: Mapping[str, Any]) -> str:
        """Start an app. An app that goes on where it was keeps its parameters, so the page's settings are also asked
        for as parameters."""
        assert self._actions is not None
        settings = settings_of(asked)
        robots, near = self._meant(asked)
        if settings and (silent := [robot for robot in robots if robot not in near]):
            raise LocalError(f"start: {' '.join(silent)} cannot be given parameters: no bus is reached there")
        values = on_top(AppConfig(), settings, robots)
        app = str(asked["app"])
        # Requests that an earlier run has not answered are not for this one.
        earlier = {(robot, app): self._asked.pop((robot, app)) for robot in robots if (robot, app) in self._asked}
        try:
            done = self._actions.acts["start"](asked)
        except BaseException:
            self._asked = earlier | self._asked  # what was asked for meanwhile is newer
            raise
        for robot in near if settings else ():
            self._let(robot, app, values.of(robot), START_S)
        return done

    def _set(self, asked: Mapping[str, Any]) -> str:
        app, name, value = str(asked["app"]), str(asked["name"]), asked["value"]
        if not is_name(app):
            raise LocalError("set: expected the name of an app")
        check_parameter(name, value)
        robots, near = self._meant(asked)
        values: dict[str, Value] = {name: value}
        assert self._actions is not None
        silent = self._actions.give([robot for robot in robots if robot not in near], app, values)
        if silent == robots:
            raise LocalError(f"set: {asked.get('robot') or 'no robot'} is not reached")
        for robot in near:
            self._let(robot, app, values, ANSWER_S)
        asked_of = " ".join(robot for robot in robots if robot not in silent)
        return f"{app}: {name}={value} asked of {asked_of}{_except(silent)}"

    def _let(self, robot: str, app: str, values: dict[str, Value], seconds: float) -> None:
        """Ask a robot for these parameters, again and again until it has answered or `seconds` have passed."""
        unanswered, until = self._asked.get((robot, app), (None, 0.0))
        before = {} if unanswered is None else unanswered.parameters
        request = SetAppParameters(new_ticket(), {**before, **values})
        self._ask(robot, app, request)  # this comes first: a request that cannot be sent is not repeated
        self._asked[robot, app] = request, max(until, clock.now() + seconds)

    def _ask(self, robot: str, app: str, request: SetAppParameters) -> None:
        if (bus := self._feed.buses.get(robot)) is not None:  # a robot may have left the simulation
            bus.publish(key(robot, f"app/{app}", "set", "parameters"), request, urgent=True)

    def _ask_again(self) -> None:
        for (robot, app), (request, until) in list(self._asked.items()):
            with self._feed.lock:
                answer = self._feed.picture.newest(robot, f"app/{app}/parameters_set")
                answered = isinstance(answer, dict) and answer.get("ticket") == request.ticket
                if late := not answered and clock.now() > until:
                    said = ", ".join(f"{name}={value}" for name, value in request.parameters.items())
                    self._feed.picture.note(self._feed.now(), robot, "warning", f"app/{app} has not answered: {said}")
            if not answered and not late:
                self._ask(robot, app, request)
            elif self._asked.get((robot, app), (None,))[0] is request:  # no newer request came meanwhile
                self._asked.pop((robot, app), None)


def _except(silent: list[str]) -> str:
    return f", not of {' '.join(silent)}: they are not reached" if silent else ""
