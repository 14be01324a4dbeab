"""Names that two robots have: which ones this robot knows of, and whether a robot's process is a second one.

A copied SD card, or a second swarm with the same configuration and key, gives two running robots one name. What they
say cannot be told apart once it has been relayed, so only one of them may have links. A robot is known by the process
number that it draws at each start of its mesh (HELLO and link state carry it). A neighbour refuses a process while
another one with that name has a link with it, or with any robot in reach. So the first process stays; the second is
told why, and calls again with its usual back-off until the first one is gone.
"""

from collections.abc import Iterator

from services.mesh.core.routing.link_state import LinkState

NAMED_AFTER = 5.0
"""Seconds between the first and the last sign of a second robot until the clash is named. A robot that was started anew
looks like a second one until its neighbours have noticed that its earlier process is silent, 3 s at most."""

FORGET = 30.0
"""Seconds without a sign of the second robot after which the clash is over. A robot that is refused calls again after
7.5 s at most."""

DOUBT = 2.0
"""Seconds for which the link state must name another process than the one at the end of a link until that is a sign:
news of a new process take a moment to come round."""

PROBATION = 30.0
"""Seconds for which a link is young. A young link ends when the link state names another process: both robots were
switched on at the same time. An older link stays: what members tell cannot end it."""


class _Signs:
    """What speaks for a second robot of one name."""

    __slots__ = ("first", "last", "process", "text")

    def __init__(self, process: int, now: float) -> None:
        self.process = process
        """The one that is refused, or doubted. Another one each time is a robot that is started again and again."""
        self.first = now
        self.last = now
        self.text = ""


class Clashes:
    """The names of which this robot has seen two owners. Calls with `now` must not go back in time."""

    def __init__(self, me: str, robots: frozenset[str], map: LinkState) -> None:
        """`map` holds the link state that all robots tell."""
        self._me = me
        self._robots = robots
        self._map = map
        self._signs: dict[str, _Signs] = {}
        self._doubts: dict[str, float] = {}
        """Links whose end is not the process that the link state names, and since when."""

    def elsewhere(self, robot: str, process: int) -> str | None:
        """A robot in reach, not this one, that has a link with another process of `robot` than `process`; None where
        there is none, or where processes are not known."""
        told = self._map.advertised(robot)
        if told is None or not told.process or not process or told.process == process or told.leaving:
            return None
        for peer in told.neighbours:
            other = self._map.advertised(peer)
            if peer != self._me and other is not None and robot in other.neighbours and self._map.route(peer):
                return peer
        return None

    def seen(self, robot: str, process: int, text: str, now: float) -> None:
        """Note a sign that a process is a second robot of this name; `text` says what the sign is."""
        signs = self._signs.get(robot)
        if signs is None or signs.process != process or now > signs.last + FORGET:
            signs = self._signs[robot] = _Signs(process, now)
        signs.last, signs.text = now, text

    def check_link(self, robot: str, process: int, since: float, now: float) -> str:
        """Look at a link that came up at `since`. The reason to end it; empty where it is to stay."""
        if (other := self.elsewhere(robot, process)) is None:
            self._doubts.pop(robot, None)
            return ""
        if now < self._doubts.setdefault(robot, now) + DOUBT:
            return ""
        text = f"{self._me} and {other} have links with two of them"
        self.seen(robot, process, text, now)
        return text if now < since + PROBATION else ""

    def link_down(self, robot: str) -> None:
        """A link is gone."""
        self._doubts.pop(robot, None)

    def own(self, now: float) -> Iterator[str]:
        """Names of which this robot itself has seen two owners."""
        for robot, signs in self._signs.items():
            if signs.last - signs.first >= NAMED_AFTER and now <= signs.last + FORGET:
                yield robot

    def named(self, now: float) -> dict[str, str]:
        """Names that two robots have, by what this robot or others in reach have seen, and what that is."""
        found = {robot: self._signs[robot].text for robot in self.own(now)}
        for teller in sorted(self._map.tellers):
            told = self._map.advertised(teller)
            if told is not None and self._map.route(teller) is not None:
                for robot in set(told.twins) & self._robots:
                    found.setdefault(robot, f"{teller} says so")
        return {robot: f"another robot is called {robot}, too: {text}" for robot, text in sorted(found.items())}
