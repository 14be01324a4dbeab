"""The client of the overlays, and of the mesh clock, on a bus that a test plays."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from swarm import clock
from swarm.app import mesh_clock, overlays
from swarm.app.mesh_clock import MeshClock
from swarm.app.overlays import MAX_COLLECTED, MAX_OPEN, Message, Overlays
from swarm.errors import LocalError
from swarm.messages import Clock, Flooded, FloodRequest, Progress, Reminder, SendRequest, Sent
from swarm.messages.codec import MAX_BINARY, encode


class FakeBus:
    """Remembers what was published; the test says what comes in, and when the bus comes back."""

    def __init__(self) -> None:
        self.published: list[tuple[str, object]] = []
        self.asked: list[str] = []
        self._subscribers: list[tuple[str, Callable[[str, bytes], None]]] = []
        self._watchers: list[Callable[[bool], None]] = []

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        self.published.append((key, message))

    def subscribe(self, keys: str, callback: Callable[[str, bytes], None]) -> None:
        self._subscribers.append((keys, callback))

    def on_change(self, callback: Callable[[bool], None]) -> None:
        self._watchers.append(callback)

    def ask(self, key: str, on_reply: Callable[[str, bytes], None], **_: object) -> None:
        self.asked.append(key)

    def come(self, key: str, payload: bytes) -> None:
        for keys, callback in self._subscribers:
            if keys == key or keys == key.replace("swarm/r1/", "swarm/*/"):
                callback(key, payload)

    def change(self, connected: bool) -> None:
        for watcher in self._watchers:
            watcher(connected)


@pytest.fixture
def bus() -> FakeBus:
    return FakeBus()


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    times = [100.0]
    monkeypatch.setattr(clock, "now", lambda: times[0])
    return times


def client(bus: FakeBus) -> Overlays:
    return Overlays(bus, "r0", "test", now=lambda: clock.now())


def sent(ticket: str, *, delivered: bool = True) -> bytes:
    return encode(Sent(0.0, ticket, "test", "r1", delivered, "" if delivered else "no way"))


def test_an_answer_can_be_looked_for_by_its_ticket(bus: FakeBus, now: list[float]) -> None:
    each = client(bus)
    handle = each.send("r1", b"x")
    flood = each.flood(b"y")
    assert [type(message) for _, message in bus.published] == [SendRequest, FloodRequest]
    assert (each.answer(handle.ticket), handle.answer, handle.done) == (None, None, False)
    bus.come("swarm/r0/mesh/sent", sent(handle.ticket))
    answer = each.answer(handle.ticket)
    assert isinstance(answer, Sent)
    assert answer is handle.answer is handle.result(0.0)
    bus.come("swarm/r0/mesh/flooded", encode(Flooded(0.0, flood.ticket, "test", ("r1",), True, "")))
    assert each.answer(flood.ticket) == flood.result(0.0)
    assert each.answer("no such ticket") is None
    bus.come("swarm/r0/mesh/sent", sent("somebody else's"))
    bus.come("swarm/r0/mesh/sent", b"no msgpack")


def test_who_looks_for_an_answer_asks_again_at_times_and_no_more_when_it_is_there(
    bus: FakeBus, now: list[float]
) -> None:
    handle = client(bus).send("r1", b"x")
    for _ in range(20):
        now[0] += 0.1
        assert handle.answer is None
    assert len(bus.published) == 1 + 3
    assert len({message.ticket for _, message in bus.published}) == 1  # type: ignore[attr-defined]
    bus.come("swarm/r0/mesh/sent", sent(handle.ticket))
    now[0] += 10.0
    assert handle.answer is not None
    handle.ask_again()
    bus.change(connected=True)
    assert len(bus.published) == 4


def test_what_was_asked_while_the_bus_was_away_is_asked_again_when_it_is_back(bus: FakeBus) -> None:
    each = client(bus)
    told: list[Sent] = []
    first, second = each.send("r1", b"x"), each.send("r1", b"y")
    second.on_done(told.append)
    bus.come("swarm/r0/mesh/sent", sent(first.ticket))
    bus.published.clear()
    bus.change(connected=False)
    assert not bus.published
    bus.change(connected=True)
    assert [message.payload for _, message in bus.published] == [b"y"]  # type: ignore[attr-defined]
    bus.come("swarm/r0/mesh/sent", sent(second.ticket, delivered=False))
    bus.come("swarm/r0/mesh/sent", sent(second.ticket, delivered=False))
    assert [answer.problem for answer in told] == ["no way"]


def test_no_answer_in_time_is_said(bus: FakeBus) -> None:
    with pytest.raises(TimeoutError, match=r"no answer of the mesh within 0\.01 s"):
        client(bus).send("r1", b"x").result(0.01)


@pytest.mark.parametrize("payload", ["text", {"x": 1}, 5, None])
def test_a_payload_that_is_not_of_bytes_is_refused_with_what_makes_some(bus: FakeBus, payload: Any) -> None:
    each = client(bus)
    for ask in (lambda: each.flood(payload), lambda: each.send("r1", payload)):
        with pytest.raises(LocalError, match=r"a payload is of bytes, got .*: text\.encode\(\)"):
            ask()
    assert not bus.published


@pytest.mark.parametrize("timeout", [0.0, -1.0, math.nan, math.inf])
def test_a_timeout_in_which_nothing_arrives_is_refused(bus: FakeBus, timeout: float) -> None:
    with pytest.raises(LocalError, match="timeout: expected a time above 0 s, got"):
        client(bus).send("r1", b"x", timeout=timeout)
    assert not bus.published


def test_a_robot_sends_nothing_to_itself(bus: FakeBus) -> None:
    answer = client(bus).send("r0", b"x").answer
    assert answer is not None
    assert (answer.delivered, answer.problem) == (False, "refused: a robot sends no message to itself")
    assert not bus.published


def test_old_requests_are_forgotten(bus: FakeBus) -> None:
    each = client(bus)
    tickets = [each.flood(b"").ticket for _ in range(MAX_OPEN + 1)]
    bus.come("swarm/r0/mesh/flooded", encode(Flooded(0.0, tickets[0], "test", (), True, "")))
    bus.come("swarm/r0/mesh/flooded", encode(Flooded(0.0, tickets[1], "test", (), True, "")))
    assert each.answer(tickets[0]) is None
    assert each.answer(tickets[1]) is not None


def test_messages_of_others_wait_in_order_within_bounds(bus: FakeBus, monkeypatch: pytest.MonkeyPatch) -> None:
    each = client(bus)
    each.collect()
    bus.come("swarm/r1/app/test/flood", b"a")
    bus.come("swarm/r1/app/test/send/r0", b"b")
    bus.come("swarm/r1/app/test/send/r2", b"not ours")
    bus.come("swarm/r1/app/other/flood", b"not ours")
    bus.come("swarm/r0/app/test/flood", b"our own")
    assert each.messages() == [Message("r1", b"a", flooded=True), Message("r1", b"b", flooded=False)]
    assert each.messages() == []
    for number in range(MAX_COLLECTED + 10):
        bus.come("swarm/r1/app/test/flood", str(number).encode())
    assert [int(message.payload) for message in each.messages()] == list(range(10, MAX_COLLECTED + 10))
    monkeypatch.setattr(overlays, "MAX_COLLECTED_BYTES", 1000)
    for number in range(5):
        bus.come("swarm/r1/app/test/flood", bytes((number,)) * 400)
    assert [message.payload[0] for message in each.messages()] == [3, 4]


def test_the_mesh_clock_is_asked_for_when_the_bus_comes(bus: FakeBus, now: list[float]) -> None:
    each = MeshClock(bus, "r0", lambda: clock.now())
    assert (each.now(), each.error, each.root, each.monotonic(1.0)) == (None,) * 4
    bus.change(connected=True)
    assert bus.asked == ["swarm/r0/mesh/clock"]
    bus.come("swarm/r0/mesh/clock", encode(Clock(90.0, 7.0, 1e-4, "r1", 2, 0.003)))
    assert each.now() == pytest.approx(107.001)
    assert (each.error, each.root) == (0.003, "r1")
    assert each.monotonic(107.001) == pytest.approx(100.0)
    bus.come("swarm/r0/mesh/clock", b"no msgpack")
    assert mesh_clock.mesh_time(Clock(90.0, 7.0, 1e-4, "r1", 2, 0.003), 100.0) == each.now()


def test_a_large_request_is_made_once_and_then_only_reminded_of(bus: FakeBus, now: list[float]) -> None:
    each = client(bus)
    handle = each.send("r1", bytes(500_000))
    (request,) = bus.published
    assert request[0] == "swarm/r0/mesh/set/send"
    for moved in (0, 188_000):
        now[0] += overlays.REPEAT
        assert handle.answer is None
        assert bus.published.pop() == ("swarm/r0/mesh/set/remind", Reminder(handle.ticket))
        bus.come("swarm/r0/mesh/progress", encode(Progress(1.0, handle.ticket, True, 500_000, moved)))
        assert handle.moved == moved
    assert bus.published == [request]
    bus.come("swarm/r0/mesh/progress", encode(Progress(1.0, handle.ticket, False, 0, 0)))
    assert bus.published == [request, request], "it was lost, or the mesh was started anew"
    bus.come("swarm/r0/mesh/sent", encode(Sent(1.0, handle.ticket, "test", "r1", True, "")))
    assert handle.done
    bus.come("swarm/r0/mesh/progress", encode(Progress(1.0, handle.ticket, False, 0, 0)))
    bus.come("swarm/r0/mesh/progress", encode(Progress(1.0, "another", False, 0, 0)))
    bus.come("swarm/r0/mesh/progress", b"nonsense")
    assert len(bus.published) == 2


def test_what_the_bus_cannot_carry_is_refused_at_once(bus: FakeBus) -> None:
    each = client(bus)
    for ask in (lambda: each.flood(bytes(MAX_BINARY + 1)), lambda: each.send("r1", bytes(MAX_BINARY + 1))):
        with pytest.raises(LocalError, match="983041 bytes, the bus takes at most 983040"):
            ask()
    assert bus.published == []


def test_all_that_is_promised_to_apps_is_taken(bus: FakeBus) -> None:
    each = client(bus)
    each.flood(bytes(MAX_BINARY))
    each.send("r1", bytes(MAX_BINARY))
    requests = [payload for name, payload in bus.published if "/set/" in name]
    assert len(requests) == 2


def test_a_large_request_beyond_the_bound_is_refused_and_older_ones_wait_on(bus: FakeBus, now: list[float]) -> None:
    """The mesh may be away for minutes, while an app floods on."""
    each = client(bus)
    small = [each.flood(b"small") for _ in range(300)]
    others = [each.send("r1", bytes(MAX_BINARY)) for _ in range(4)]
    now[0] += overlays.REPEAT
    last = each.send("r1", bytes(MAX_BINARY))
    assert last.answer is not None
    assert last.answer.problem == "refused: requests of more than 4 MiB wait for the mesh"
    assert not any(handle.done for handle in (*small, *others))
    assert ("swarm/r0/mesh/set/remind", Reminder(others[0].ticket)) in bus.published, "its answer may have been lost"
    bus.come("swarm/r0/mesh/sent", encode(Sent(1.0, others[0].ticket, "test", "r1", True, "")))
    assert not each.send("r1", bytes(MAX_BINARY)).done
