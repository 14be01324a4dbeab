"""Which keys a neighbour may bind a channel to, and which messages of other robots a robot accepts."""

from collections.abc import Callable

from services.mesh.core.wire.frames import FLOOD
from swarm.errors import PayloadError
from swarm.messages.keys import is_name, parse


class Admission:
    """Of one robot."""

    def __init__(
        self, me: str, robots: frozenset[str], flood: Callable[[str], bool], unicast: Callable[[str, str], bool]
    ) -> None:
        """`flood(key)` and `unicast(sender, key)` say which keys the relay rules let in."""
        self._me = me
        self._robots = robots
        self._flood = flood
        self._unicast = unicast

    def binds(self, peer: str, overlay: int, key: str) -> bool:
        """Whether a neighbour may bind a channel of flood or unicast to this key; keys of carried values aside."""
        try:
            robot, service, topic = parse(key)
        except PayloadError:
            return False
        if robot not in self._robots:
            return False
        if overlay != FLOOD:
            return robot == peer and service == "mesh" and topic in ("unicast", "pieces")
        if service == "mesh" and topic in ("digest", "halt", "topology"):
            return robot == peer
        if (service, topic) in (("mesh", "lsa"), ("mesh", "stopped"), ("mesh", "watch")):
            return True
        return _is_app_flood(service, topic) or self._flood(key)

    def accepts(self, sender: str, key: str) -> bool:
        """Whether a unicast message of `sender` may appear on the own bus under this key."""
        if sender == self._me:
            return False  # what we send ourselves crosses no link: somebody pretends to be us
        robot, service, topic = parse(key)
        if robot == sender and service == "app":
            chunks = topic.split("/")
            if len(chunks) == 3 and chunks[1:] == ["send", self._me] and is_name(chunks[0]):
                return True
        return (robot, service, topic) == (sender, "mesh", "view") or self._unicast(sender, key)


def _is_app_flood(service: str, topic: str) -> bool:
    app, _, rest = topic.partition("/")
    return service == "app" and rest == "flood" and is_name(app)
