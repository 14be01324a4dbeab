"""What a page may do to the swarm where it was started with `--control`. Without that every command is refused."""

import os
import threading
from collections.abc import Mapping
from typing import Any

from laptop.view.feed import LiveFeed, Publisher
from laptop.view.robot_actions import PageAction, RobotActions, named
from swarm import clock
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.messages import Arm, SetAppParameters, Stop
from swarm.messages.codec import Value
from swarm.messages.keys import STOP, is_name, key

REASON = "the page of swarm view"
ANSWER_S = 5.0
"""s for which an app is asked to set a parameter: it may be about to start, and a bus may lose a request."""


@frozen
class _Halt:
    """A stop for all robots, or its end, that not all have confirmed. Each one is an object of its own."""

    stop: bool


class Control:
    """Carries out what pages ask, in any threads."""

    def __init__(self, feed: LiveFeed, actions: RobotActions | None) -> None:
        """`actions`: what can be done besides what goes over a bus; None where the page only watches."""
        self._feed = feed
        self._actions = actions
        self._halting = threading.Lock()
        """Held while a stop or its end goes out, so that the later of two holds on every robot."""
        self._wanted: _Halt | None = None
        self._asked: dict[tuple[str, str], tuple[SetAppParameters, float]] = {}
        """What apps have not answered yet: by robot and app, and until when they are asked."""
        self.acts: dict[str, PageAction] = {}
        """What pages may ask for."""
        if actions is not None:
            self.acts |= {
                "stop": lambda _: self._halt(stop=True),
                "arm": lambda _: self._halt(stop=False),
                "set": self._set,
                **actions.acts,
            }

    def close(self) -> None:
        """Give up what is under way."""
        if self._actions is not None:
            self._actions.close()

    def do(self, asked: object) -> str:
        """Carry out `{act: NAME, ...}`; what was done, in words. Raises `LocalError`."""
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
        """Say again what robots have not confirmed, a stop or its end or parameters: a bus may lose it."""
        self._halt_again()
        self._ask_again()

    def _halt_again(self) -> None:
        wanted = self._wanted
        if wanted is None:
            return
        # Before the other lock: a stop does not wait for a picture that is being drawn.
        with self._feed.lock:
            said = {name: self._feed.picture.newest(name, "mesh/stopped") for name in self._feed.buses}
        late = [name for name, value in said.items() if not _agrees(value, wanted.stop)]
        with self._halting:
            if self._wanted is not wanted:
                return  # a later one has gone out meanwhile
            if not late:
                self._wanted = None
            for name in late:
                self._give(name, self._feed.buses[name], stop=wanted.stop)

    def _halt(self, *, stop: bool) -> str:
        self._feed.check_control()
        with self._halting:
            self._wanted = _Halt(stop)
            for name, bus in self._feed.buses.items():
                self._give(name, bus, stop=stop)
        return "stop given to all robots" if stop else "stops taken back"

    def _give(self, name: str, bus: Publisher, *, stop: bool) -> None:
        if stop:
            bus.publish(STOP, Stop(clock.now(), name, REASON), urgent=True)
        else:
            bus.publish(key(name, "mesh", "set", "arm"), Arm(clock.now(), name), urgent=True)

    def _set(self, asked: Mapping[str, Any]) -> str:
        app, name, value = str(asked["app"]), str(asked["name"]), asked["value"]
        if not is_name(app) or not name.isidentifier() or not isinstance(value, bool | int | float | str):
            raise LocalError("set: expected the names of an app and a parameter, and a number, a text, true or false")
        buses, config = self._feed.buses, self._feed.config
        everybody = buses.keys() if config is None else config.names
        robots = [named(asked["robot"], everybody)] if asked.get("robot") else list(everybody)
        near = [robot for robot in robots if robot in buses and buses[robot].connected]
        values: dict[str, Value] = {name: value}
        assert self._actions is not None
        silent = self._actions.give([robot for robot in robots if robot not in near], app, values)
        if silent == robots:
            raise LocalError(f"set: {asked.get('robot') or 'no robot'} is not reached")
        for robot in near:
            request = SetAppParameters(f"{os.getpid()}-{os.urandom(4).hex()}", values)
            self._ask(robot, app, request)  # first: what the way there does not take is not asked again
            self._asked[robot, app] = request, clock.now() + ANSWER_S
        alone = f", not of {' '.join(silent)}: they are not reached" if silent else ""
        return f"{app}: {name}={value} asked of {' '.join(robot for robot in robots if robot not in silent)}{alone}"

    def _ask(self, robot: str, app: str, request: SetAppParameters) -> None:
        self._feed.buses[robot].publish(key(robot, f"app/{app}", "set", "parameters"), request, urgent=True)

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
            elif self._asked.get((robot, app), (None,))[0] is request:  # none newer came meanwhile
                del self._asked[robot, app]


def _agrees(value: object, stopped: bool) -> bool:
    return isinstance(value, dict) and value.get("stopped") is stopped
