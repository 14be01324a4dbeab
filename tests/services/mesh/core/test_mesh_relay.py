"""The relay: key expressions, who gets what, what may come in, and maximum rates."""

from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.relay import KeyRelay, match, matches, may_cross
from services.mesh.core.wire import frames
from swarm.config.types import DEFAULT_RELAY, RelayRule

POSE = "swarm/r1/dwm/pose"


def relay(*rules: RelayRule, peers: Sequence[str] = ("r0", "r2")) -> KeyRelay:
    return KeyRelay("r1", peers, rules)


def sent(relay: KeyRelay, key: str, payload: bytes = b"x", now: float = 0.0) -> list[tuple[str, bytes]]:
    """Who gets what when every matching subscription delivers a sample, as Zenoh does."""
    sends = []
    for source, expression in enumerate(relay.subscriptions):
        if matches(expression, key):
            sends += relay.publish(source, key, payload, now)
    return [(peer, send.payload) for send in sends for peer in send.leg.peers]


@pytest.mark.parametrize(
    ("expression", "key", "matching"),
    [
        ("swarm/r0/dwm/pose", "swarm/r0/dwm/pose", True),
        ("swarm/r0/dwm/pose", "swarm/r0/dwm/poses", False),
        ("swarm/r0/*/pose", "swarm/r0/dwm/pose", True),
        ("swarm/r0/*/pose", "swarm/r0/a/b/pose", False),
        ("swarm/r0/**/pose", "swarm/r0/pose", True),
        ("swarm/r0/**/pose", "swarm/r0/a/b/pose", True),
        ("swarm/r0/**", "swarm/r0", True),
        ("swarm/r0/**", "swarm/r0/a/b", True),
        ("swarm/r0/**", "swarm/r01/a", False),
        ("swarm/**", "swarm/r0/a", True),
        ("**", "swarm/r0/a", True),
        ("*/r0/a", "swarm/r0/a", True),
        ("swarm/r0/a.b", "swarm/r0/axb", False),
    ],
)
def test_a_key_matches_the_expressions_that_include_it(expression: str, key: str, matching: bool) -> None:
    assert matches(expression, key) is matching


def naive(expression: list[str], key: list[str]) -> bool:
    if not expression:
        return not key
    if expression[0] == "**":
        return naive(expression[1:], key) or (bool(key) and naive(expression, key[1:]))
    return bool(key) and expression[0] in ("*", key[0]) and naive(expression[1:], key[1:])


chunks = st.sampled_from(("a", "b", "ab"))


@given(
    st.lists(chunks | st.sampled_from(("*", "**")), min_size=1, max_size=6), st.lists(chunks, min_size=1, max_size=6)
)
def test_key_expressions_are_those_of_zenoh(expression: list[str], key: list[str]) -> None:
    assert matches("/".join(expression), "/".join(key)) is naive(expression, key)


@pytest.mark.parametrize(
    ("expression", "key", "names"),
    [
        ("swarm/{self}/dwm/pose", "swarm/r0/dwm/pose", {"self": "r0"}),
        ("swarm/{self}/app/*/sync/*/{peer}", "swarm/r0/app/a/sync/c/r1", {"self": "r0", "peer": "r1"}),
        ("swarm/{peer}/**/set/*", "swarm/r1/app/a/set/x", {"peer": "r1"}),
        ("swarm/{self}/**/{peer}/**", "swarm/r0/a/b/c", {"self": "r0", "peer": "c"}),
        ("swarm/{self}/dwm/pose", "swarm/r0/dwm/range", None),
        ("swarm/{self}/**", "swarm/r0//a", None),
        ("swarm/{self}/**", "swarm/", None),
    ],
)
def test_the_names_in_a_key(expression: str, key: str, names: dict[str, str] | None) -> None:
    assert match(expression, key) == names


def test_a_key_goes_to_all_neighbours_or_to_the_one_it_names() -> None:
    both = relay(*DEFAULT_RELAY)
    key = "swarm/r1/app/consensus/sync/a-1-2-b"
    assert sent(both, key) == [("r0", b"x"), ("r2", b"x")]
    assert sent(both, key + "/r2") == [("r2", b"x")]
    assert sent(both, key + "/r7") == []
    assert sent(both, "swarm/r1/app/consensus/state") == []


def test_around_a_silent_link_is_for_neighbours_alone_and_comes_in_from_them() -> None:
    one = relay(*DEFAULT_RELAY)
    key = "swarm/r1/app/x/sync/c/r2/around"
    assert sent(one, key) == [("r2", b"x")]
    assert sent(one, "swarm/r1/app/x/sync/c/r9/around") == []
    assert one.admits_unicast("r2", "swarm/r2/app/x/sync/c/r1/around")
    assert not one.admits("r2", "swarm/r2/app/x/sync/c/r1/around")
    assert not one.admits_unicast("r2", "swarm/r2/app/x/sync/c/r0/around")
    assert not one.admits_unicast("r2", "swarm/r0/app/x/sync/c/r1/around")
    assert not one.admits_unicast("r9", "swarm/r9/app/x/sync/c/r1/around")
    one.set_peers(["r0"])
    assert sent(one, key) == []
    assert not one.admits_unicast("r2", "swarm/r2/app/x/sync/c/r1/around")


def test_classes_and_queues_are_those_of_the_rule() -> None:
    both = relay(RelayRule("swarm/{self}/dwm/*"), RelayRule("swarm/{self}/a/*", priority="control", queue="all"))
    (pose,) = both.publish(0, POSE, b"", 0.0)
    (other,) = both.publish(1, "swarm/r1/a/b", b"", 0.0)
    assert (pose.leg.priority, pose.leg.latest) == (frames.BULK, True)
    assert (other.leg.priority, other.leg.latest) == (frames.CONTROL, False)


def test_overlapping_rules_send_once_and_the_first_one_decides() -> None:
    both = relay(
        RelayRule("swarm/{self}/dwm/{peer}", priority="sync"),
        RelayRule("swarm/{self}/dwm/*"),
        RelayRule("swarm/{self}/**", priority="control"),
    )
    assert sorted(sent(both, POSE)) == [("r0", b"x"), ("r2", b"x")]
    assert sorted(sent(both, "swarm/r1/dwm/r2")) == [("r0", b"x"), ("r2", b"x")]
    (first, second) = both.publish(0, "swarm/r1/dwm/r2", b"x", 0.0)
    assert (first.leg.peers, first.leg.priority) == (("r2",), frames.SYNC)
    assert (second.leg.peers, second.leg.priority) == (("r0",), frames.BULK)


@pytest.mark.parametrize(
    "key", ["swarm/r0/dwm/pose", "swarm/r1/balancer/set/mode", "swarm/r1/app/x/set/y", "swarm/stop", "swarm/r1/dwm"]
)
def test_what_is_not_ours_or_a_command_never_leaves(key: str) -> None:
    everything = relay(RelayRule("swarm/**"))
    assert sent(everything, key) == []
    assert sent(everything, POSE) == [("r0", b"x"), ("r2", b"x")]


def test_what_comes_in_is_what_the_neighbour_would_send_us() -> None:
    own = relay(*DEFAULT_RELAY)
    key = "swarm/r0/app/consensus/sync/a-1-2-b"
    assert own.admits("r0", key)
    assert own.admits("r0", key + "/r1")
    assert not own.admits("r0", key + "/r2")
    assert not own.admits("r2", key)
    assert not own.admits("r0", "swarm/r0/dwm/pose")
    assert not own.admits("r0", "swarm/r0/app/consensus/sync/" + "x" * 300)


@given(st.text(max_size=40))
def test_any_text_may_be_offered_as_a_key(text: str) -> None:
    assert not relay(RelayRule("swarm/**")).admits("r0", "swarm/r0/set/" + text)
    if may_cross(text, "r0"):
        assert text.startswith("swarm/r0/")


def test_a_maximum_rate_holds_back_and_the_newest_value_wins() -> None:
    slow = relay(RelayRule("swarm/{self}/dwm/pose", max_rate=10.0), peers=("r0",))
    assert sent(slow, POSE, b"0", 0.0) == [("r0", b"0")]
    assert sent(slow, POSE, b"1", 0.02) == []
    assert sent(slow, POSE, b"2", 0.05) == []
    assert slow.next_deadline() == pytest.approx(0.1)
    assert slow.handle_timer(0.09) == []
    (send,) = slow.handle_timer(0.1)
    assert send.payload == b"2"
    assert slow.next_deadline() is None
    assert sent(slow, POSE, b"3", 0.15) == []
    (send,) = slow.handle_timer(0.2)
    assert send.payload == b"3"
    assert sent(slow, POSE, b"4", 0.35) == [("r0", b"4")]


@given(st.lists(st.floats(0.0, 0.3), max_size=60))
def test_a_maximum_rate_is_never_exceeded_and_the_last_value_arrives(gaps: list[float]) -> None:
    slow = relay(RelayRule("swarm/{self}/dwm/pose", max_rate=10.0), peers=("r0",))
    now, out = 0.0, []
    for number, gap in enumerate(gaps):
        while (deadline := slow.next_deadline()) is not None and deadline <= now + gap:
            now, gap = deadline, now + gap - deadline
            out += [(now, send.payload) for send in slow.handle_timer(now)]
        now += gap
        out += [(now, payload) for _, payload in sent(slow, POSE, str(number).encode(), now)]
    if (deadline := slow.next_deadline()) is not None:
        out += [(deadline, send.payload) for send in slow.handle_timer(deadline)]
    times = [time for time, _ in out]
    assert all(later - earlier > 0.1 - 1e-9 for earlier, later in pairwise(times))
    assert [payload for _, payload in out][-1:] == [str(len(gaps) - 1).encode()][: len(gaps)]


def test_a_relay_remembers_a_bounded_number_of_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.mesh.core.relay.MAX_ROUTES", 10)
    own = relay(RelayRule("swarm/{self}/dwm/*", max_rate=1.0))
    for number in range(100):
        key = f"swarm/r1/dwm/x{number}"
        sent(own, key)
        sent(own, key)
        assert len(own._routes) <= 10
        assert len(own._held) <= 10
