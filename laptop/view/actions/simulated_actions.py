"""The actions of a page on the robots of a simulation on this machine: all of them are allowed."""

from collections.abc import Mapping, Sequence
from typing import Any

from laptop.cli import hand
from laptop.view.actions.robot_actions import PageAction, cut, named, settings_of
from laptop.view.feeds.feed import SimulationFeed
from sim.control import app_requests, datagrams, link_cuts
from sim.core.actions import Carry, Lay, Press, Push
from sim.scenario.options import PRESS_S
from swarm.errors import LocalError
from swarm.messages.codec import Value

FAR_M = 1000.0


class SimulatedActions:
    """Carries out actions at once, by orders to the simulation."""

    def __init__(self, feed: SimulationFeed) -> None:
        self._feed = feed
        self.acts: Mapping[str, PageAction] = {
            "press": self._press,
            "push": self._push,
            "lay": self._lay,
            "place": self._place,
            "kill": self._kill,
            "cut": self._cut,
            "start": lambda asked: self._order("start", asked),
            "end": lambda asked: self._order("stop", asked),
        }

    def give(self, robots: Sequence[str], app: str, values: Mapping[str, Value]) -> list[str]:
        """Return all robots: every bus is near, and one that is not has gone."""
        return list(robots)

    def close(self) -> None:
        """Do nothing: no action is under way."""

    def _press(self, asked: Mapping[str, Any]) -> str:
        robot, button = self._robot(asked), str(asked["button"]).upper()
        datagrams.send_action(self._feed.directory / robot, Press(button, PRESS_S))
        return f"{robot}: pressed {button}"

    def _push(self, asked: Mapping[str, Any]) -> str:
        robot, impulse = self._robot(asked), float(asked["impulse"])
        datagrams.send_action(self._feed.directory / robot, Push(impulse))
        return f"{robot}: pushed with {impulse:g} N s"

    def _lay(self, asked: Mapping[str, Any]) -> str:
        robot, side = self._robot(asked), str(asked["side"])
        datagrams.send_action(self._feed.directory / robot, Lay(side))
        return f"{robot}: lies on its {side}"

    def _place(self, asked: Mapping[str, Any]) -> str:
        robot, x, y = self._robot(asked), float(asked["x"]), float(asked["y"])
        if not (abs(x) <= FAR_M and abs(y) <= FAR_M):
            raise LocalError(f"place: expected a place within {FAR_M:g} m, got {x:g}, {y:g}")
        datagrams.send_action(self._feed.directory / robot, Carry(x, y, 0.0))
        return f"{robot}: lies on its back at {x:.2f}, {y:.2f} m"

    def _kill(self, asked: Mapping[str, Any]) -> str:
        robot = self._robot(asked)
        service, pid = hand.end_service(self._feed.directory / robot, str(asked["service"]), "KILL")
        return f"{robot}: killed {service} (pid {pid})"

    def _cut(self, asked: Mapping[str, Any]) -> str:
        ends, seconds = cut(asked, self._feed.buses)
        link_cuts.cut_link(self._feed.directory, *ends, seconds)
        return f"{' - '.join(ends)}: " + (f"cut for {seconds:g} s" if seconds else "mended")

    def _order(self, act: str, asked: Mapping[str, Any]) -> str:
        robots = [self._robot(asked)] if asked.get("robot") else list(self._feed.buses)
        settings = [setting.text for setting in settings_of(asked)]
        return app_requests.request_app(self._feed.directory, act, str(asked["app"]), robots, settings)

    def _robot(self, asked: Mapping[str, Any]) -> str:
        return named(asked["robot"], self._feed.buses)
