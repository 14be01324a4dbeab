"""Which keys leave to which neighbour, and which may come in.

Only the own robot's keys leave, and only where a rule of the config says so. A neighbour's key comes in only
where the same rules, read from the neighbour's place, would have let it leave to us: so nothing a neighbour
sends can appear under another robot's name, nothing is relayed twice, and commands (`set/`) never cross.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from services.mesh.core.frames import BULK, CONTROL, SYNC
from swarm.config.types import RelayRule
from swarm.errors import PayloadError
from swarm.keys import parse

PRIORITIES = {"control": CONTROL, "sync": SYNC, "bulk": BULK}

MAX_ROUTES = 4096
"""Keys whose routes are remembered; past that, all are found anew and what is held back is lost."""


def pattern(expression: str) -> re.Pattern[str]:
    """A key expression as a regular expression: `*` is one chunk, `**` any number of them, none included."""
    text = ""
    for chunk in expression.split("/"):
        if chunk == "**":
            text += "(?:/[^/]+)*"
        else:
            text += "/" + ("[^/]+" if chunk == "*" else re.escape(chunk))
    return re.compile(text)


def matches(compiled: re.Pattern[str], key: str) -> bool:
    """Whether a key is one of a pattern's. The leading slash makes all chunks alike, the first included."""
    return compiled.fullmatch("/" + key) is not None


def instantiate(expression: str, me: str, peer: str) -> str:
    """A rule's key expression with its names put in."""
    return expression.replace("{self}", me).replace("{peer}", peer)


def may_cross(key: str, robot: str) -> bool:
    """Whether a key is well formed, belongs to `robot` and is no command."""
    try:
        parsed = parse(key)
    except PayloadError:
        return False
    return parsed.robot == robot and "set" not in (parsed.service, *parsed.topic.split("/"))


@dataclass
class Leg:
    """The part of a key's route that one rule makes. Only `hold`, `next_at` and `held` change."""

    key: str
    priority: int
    latest: bool
    interval: float
    """s between two values; 0 = as published."""
    peers: tuple[str, ...]
    next_at: float = 0.0
    held: bytes | None = None
    """The newest value that came too soon; it leaves at `next_at`."""


class Route(NamedTuple):
    """Where a key of this robot goes."""

    source: int
    """The subscription that delivers it; where subscriptions overlap, the others' copies are not used."""
    legs: tuple[Leg, ...]


class Send(NamedTuple):
    """A value that leaves now."""

    leg: Leg
    payload: bytes


@dataclass(frozen=True)
class _Rule:
    config: RelayRule
    to_peer: dict[str, re.Pattern[str]]
    from_peer: dict[str, re.Pattern[str]]


class Relay:
    """The rules of one robot."""

    def __init__(self, me: str, peers: Sequence[str], rules: Sequence[RelayRule]) -> None:
        self._me = me
        self._peers = tuple(peers)
        self._rules = [_compile(rule, me, self._peers) for rule in rules]
        self._routes: dict[str, Route] = {}
        self._held: list[Leg] = []
        self.subscriptions = tuple(dict.fromkeys(instantiate(rule.keys, me, "*") for rule in rules))
        """Key expressions to subscribe to on the own bus; a sample's `source` is the index in here."""
        self._sources = tuple(pattern(expression) for expression in self.subscriptions)

    def admits(self, peer: str, key: str) -> bool:
        """Whether a key of `peer` may appear on our bus."""
        return may_cross(key, peer) and any(matches(rule.from_peer[peer], key) for rule in self._rules)

    def publish(self, source: int, key: str, payload: bytes, now: float) -> list[Send]:
        """What leaves because of a sample that subscription number `source` delivered."""
        route = self._routes.get(key) or self._find(key)
        if route.source != source:
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
            sends.append(Send(leg, payload))
        return sends

    def handle_timer(self, now: float) -> list[Send]:
        """What was held back by a maximum rate and leaves now."""
        due = [leg for leg in self._held if leg.next_at <= now]
        if not due:
            return []
        self._held = [leg for leg in self._held if leg.next_at > now]
        sends = []
        for leg in due:
            assert leg.held is not None
            sends.append(Send(leg, leg.held))
            leg.held = None
            leg.next_at = now + leg.interval
        return sends

    def next_deadline(self) -> float | None:
        """When the next held value leaves."""
        return min((leg.next_at for leg in self._held), default=None)

    def _find(self, key: str) -> Route:
        source = next((index for index, each in enumerate(self._sources) if matches(each, key)), -1)
        legs = []
        open_peers = set(self._peers) if may_cross(key, self._me) else set()
        for rule in self._rules:
            peers = tuple(peer for peer in self._peers if peer in open_peers and matches(rule.to_peer[peer], key))
            if peers:
                open_peers.difference_update(peers)
                config = rule.config
                interval = 1.0 / config.max_rate if config.max_rate else 0.0
                legs.append(Leg(key, PRIORITIES[config.priority], config.queue == "latest", interval, peers))
        if len(self._routes) >= MAX_ROUTES:
            self._routes.clear()
            self._held.clear()
        route = self._routes[key] = Route(source, tuple(legs))
        return route


def _compile(rule: RelayRule, me: str, peers: tuple[str, ...]) -> _Rule:
    return _Rule(
        rule,
        {peer: pattern(instantiate(rule.keys, me, peer)) for peer in peers},
        {peer: pattern(instantiate(rule.keys, peer, me)) for peer in peers},
    )
