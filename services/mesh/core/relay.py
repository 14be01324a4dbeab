"""The rules of the relay: which keys leave to whom, by the config (`KeyRelay`), and which may come in (`Admission`).

Only the own robot's keys leave, and only where a rule of the config says so. Another robot's key comes in only
where the same rules, read from that robot's place, would have let it leave to us: so nothing a neighbour
sends can appear under another robot's name, and nothing is relayed twice. Commands (`set/`) never cross, but for
unicast rules that name them: then, and only then, a key of another robot leaves, to that robot.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from services.mesh.core.wire.frames import FLOOD, NEIGHBOURS, PRIORITIES, UNICAST
from swarm.config.types import RelayRule
from swarm.messages.keys import is_name, owner_of, parse

OVERLAYS = {"neighbours": NEIGHBOURS, "flood": FLOOD, "unicast": UNICAST, "around": UNICAST}
"""The overlays that rules name; around is unicast to a neighbour that avoids the link with it."""

MAX_ROUTES = 4096
"""Keys whose routes are remembered; past that, all are found anew and what is held back is lost."""


def match(expression: str, key: str) -> dict[str, str] | None:
    """Match a key with an expression, in which `*` is one chunk and `**` any number of them, none included. Return
    what `{self}` and `{peer}` stand for; None without a match. Keys are looked up seldom and robots in a process may
    be many, so no regular expressions, which take a quarter of a millisecond and 3 kB each."""
    chunks = key.split("/")
    return _match(expression.split("/"), chunks) if all(chunks) else None


def matches(expression: str, key: str) -> bool:
    """Return whether a key is one of an expression's."""
    return match(expression, key) is not None


def _match(expression: Sequence[str], chunks: Sequence[str]) -> dict[str, str] | None:
    if not expression:
        return None if chunks else {}
    first, rest = expression[0], expression[1:]
    if first == "**":
        # As many chunks as can be, as a regular expression has it.
        tries = (_match(rest, chunks[count:]) for count in range(len(chunks), -1, -1))
        return next((found for found in tries if found is not None), None)
    if not chunks or first not in ("*", "{self}", "{peer}", chunks[0]):
        return None
    found = _match(rest, chunks[1:])
    if found is not None and first in ("{self}", "{peer}"):
        found[first[1:-1]] = chunks[0]
    return found


def instantiate(expression: str, me: str, peer: str) -> str:
    """Return a rule's key expression with its names put in."""
    return expression.replace("{self}", me).replace("{peer}", peer)


def commands(text: str) -> int:
    """Return how many chunks of a key or a key expression are `set`."""
    return text.split("/").count("set")


def may_cross(key: str, robot: str) -> bool:
    """Return whether a key is well formed, belongs to `robot` and is no command."""
    return owner_of(key) == robot and "set" not in key.split("/")[2:]


@dataclass(slots=True)
class Leg:
    """The part of a key's route that one rule makes. Only `hold`, `next_at` and `held` change."""

    key: str
    priority: int
    latest: bool
    interval: float
    """Seconds between two values; 0 = as published."""
    peers: tuple[str, ...]
    """Neighbours; the receiver with unicast; nobody with flood."""
    overlay: int = NEIGHBOURS
    avoid_link: bool = False
    """Whether unicast must not use the link with the receiver."""
    next_at: float = 0.0
    held: bytes | None = None
    """The newest value that came too soon; it leaves at `next_at`."""


class KeyRoute(NamedTuple):
    """The destinations of a key of this robot."""

    source: int
    """The subscription that delivers it; where subscriptions overlap, the others' copies are not used."""
    legs: tuple[Leg, ...]


class RelaySend(NamedTuple):
    """A value that leaves now."""

    leg: Leg
    payload: bytes


class _Rule(NamedTuple):
    config: RelayRule
    overlay: int
    avoid_link: bool


class KeyRelay:
    """The rules of one robot."""

    def __init__(
        self, me: str, peers: Sequence[str], rules: Sequence[RelayRule], robots: Collection[str] | None = None
    ) -> None:
        """`robots` are all of the swarm, where that is more than this one and its peers."""
        self._me = me
        self._peers = tuple(sorted(peers))
        self._robots = frozenset(robots if robots is not None else (me, *peers))
        self._rules = [_Rule(rule, OVERLAYS[rule.overlay], rule.overlay == "around") for rule in rules]
        self._routes: dict[str, KeyRoute] = {}
        self._held: list[Leg] = []
        self.subscriptions = tuple(dict.fromkeys(instantiate(rule.keys, me, "*") for rule in rules))
        """Key expressions to subscribe to on the own bus; a sample's `source` is the index in here."""

    def admits(self, peer: str, key: str) -> bool:
        """Return whether a key of `peer` may appear on our bus."""
        return may_cross(key, peer) and any(
            rule.overlay == NEIGHBOURS and matches(instantiate(rule.config.keys, peer, self._me), key)
            for rule in self._rules
        )

    def admits_neighbour(self, robot: str, key: str) -> bool:
        """Return whether a key of `robot`, which links of others carry, may appear on our bus."""
        return robot in self._peers and self.admits(robot, key)

    def carries(self, key: str) -> bool:
        """Return whether a key is for the neighbours of the robot that it belongs to."""
        return self._may_cross(NEIGHBOURS, key)

    def admits_flood(self, key: str) -> bool:
        """Return whether a key may be flooded by the robot it belongs to."""
        return self._may_cross(FLOOD, key)

    def _may_cross(self, overlay: int, key: str) -> bool:
        for rule in self._rules:
            if rule.overlay == overlay and (found := match(rule.config.keys, key)) is not None:
                return may_cross(key, found["self"])
        return False

    def admits_unicast(self, sender: str, key: str) -> bool:
        """Return whether a message of `sender` to this robot may appear on our bus."""
        return any(
            self._receiver(rule, key, sender) == self._me and (sender in self._peers or not rule.avoid_link)
            for rule in self._rules
        )

    def set_peers(self, peers: Iterable[str]) -> None:
        """Replace the neighbours. What is held back leaves in its time, to the new neighbours."""
        self._peers = tuple(sorted(peers))
        held, self._held = self._held, []
        self._routes.clear()
        for old in held:
            for leg in self._find(old.key).legs:
                if leg.overlay == old.overlay and leg.interval and leg.held is None:
                    leg.held, leg.next_at = old.held, old.next_at
                    self._held.append(leg)

    def publish(self, source: int | None, key: str, payload: bytes, now: float) -> list[RelaySend]:
        """Return what leaves because of a sample that subscription number `source` delivered; None for another way."""
        route = self._routes.get(key) or self._find(key)
        if source is not None and route.source != source:
            return []
        sends = []
        for leg in route.legs:
            if leg.interval:
                if leg.held is not None or now < leg.next_at:
                    if leg.held is None:
                        self._held.append(leg)
                    leg.held = payload
                    continue
                leg.next_at = now + leg.interval
            sends.append(RelaySend(leg, payload))
        return sends

    def handle_timer(self, now: float) -> list[RelaySend]:
        """Return what was held back by a maximum rate and leaves now."""
        due = [leg for leg in self._held if leg.next_at <= now]
        if not due:
            return []
        self._held = [leg for leg in self._held if leg.next_at > now]
        sends = []
        for leg in due:
            assert leg.held is not None
            sends.append(RelaySend(leg, leg.held))
            leg.held = None
            leg.next_at = now + leg.interval
        return sends

    def next_deadline(self) -> float | None:
        """Return the time at which the next held value leaves."""
        return min(leg.next_at for leg in self._held) if self._held else None

    def _find(self, key: str) -> KeyRoute:
        source = next((index for index, each in enumerate(self.subscriptions) if matches(each, key)), -1)
        legs = []
        own = may_cross(key, self._me)
        open_peers = set(self._peers) if own else set()
        for rule in self._rules:
            if rule.overlay == FLOOD:
                if own and open_peers >= set(self._peers) and matches(rule.config.keys, key):
                    open_peers.clear()
                    legs.append(_leg(key, rule, ()))
                    break
            elif rule.overlay == UNICAST:
                to = self._receiver(rule, key, self._me)
                if to is None or to == self._me or (rule.avoid_link and to not in self._peers):
                    continue
                if not any(to in leg.peers for leg in legs):
                    open_peers.discard(to)
                    legs.append(_leg(key, rule, (to,)))
            else:
                peers = tuple(
                    peer
                    for peer in self._peers
                    if peer in open_peers and matches(instantiate(rule.config.keys, self._me, peer), key)
                )
                if peers:
                    open_peers.difference_update(peers)
                    legs.append(_leg(key, rule, peers))
        if len(self._routes) >= MAX_ROUTES:
            self._routes.clear()
            self._held.clear()
        route = self._routes[key] = KeyRoute(source, tuple(legs))
        return route

    def _receiver(self, rule: _Rule, key: str, sender: str) -> str | None:
        """Return the robot that a unicast rule sends a key of `sender`'s bus to; None where it does not."""
        if rule.overlay != UNICAST or (found := match(rule.config.keys, key)) is None:
            return None
        if found.get("self", sender) != sender or commands(key) != commands(rule.config.keys):
            return None
        to = found["peer"]
        # Under its own name a robot tells, under the receiver's it commands.
        return to if owner_of(key) == (to if commands(key) else sender) and to in self._robots else None


def _leg(key: str, rule: _Rule, peers: tuple[str, ...]) -> Leg:
    config = rule.config
    interval = 1.0 / config.max_rate if config.max_rate else 0.0
    priority, latest = PRIORITIES[config.priority], config.queue == "latest"
    return Leg(key, priority, latest, interval, peers, rule.overlay, rule.avoid_link)


class Admission:
    """The rules of admission: to which keys a neighbour may bind a channel, and which messages of other robots are
    accepted."""

    def __init__(
        self, me: str, robots: frozenset[str], flood: Callable[[str], bool], unicast: Callable[[str, str], bool]
    ) -> None:
        """`flood(key)` and `unicast(sender, key)` say which keys the relay rules let in."""
        self._me = me
        self._robots = robots
        self._flood = flood
        self._unicast = unicast

    def binds(self, peer: str, overlay: int, key: str) -> bool:
        """Return whether a neighbour may bind a channel of flood or unicast to this key; keys of carried values
        aside."""
        if owner_of(key) not in self._robots:
            return False
        robot, service, topic = parse(key)
        if overlay != FLOOD:
            return robot == peer and service == "mesh" and topic in ("unicast", "pieces")
        if is_between_neighbours(key):
            return robot == peer
        if (service, topic) in (("mesh", "lsa"), ("mesh", "stopped"), ("mesh", "watch")):
            return True
        return _is_app_flood(service, topic) or self._flood(key)

    def accepts(self, sender: str, key: str) -> bool:
        """Return whether a unicast message of `sender` may appear on the own bus under this key."""
        if sender == self._me:
            return False  # what we send ourselves crosses no link: somebody pretends to be us
        robot, service, topic = parse(key)
        if robot == sender and service == "app":
            chunks = topic.split("/")
            if len(chunks) == 3 and chunks[1:] == ["send", self._me] and is_name(chunks[0]):
                return True
        return (robot, service, topic) == (sender, "mesh", "view") or self._unicast(sender, key)


def is_between_neighbours(key: str) -> bool:
    """Return whether a robot tells something under this key to each of its neighbours, and none of them hands it on."""
    _, service, topic = parse(key)
    return service == "mesh" and topic in ("digest", "halt", "topology")


def _is_app_flood(service: str, topic: str) -> bool:
    app, _, rest = topic.partition("/")
    return service == "app" and rest == "flood" and is_name(app)
