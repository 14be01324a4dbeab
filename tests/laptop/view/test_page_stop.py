"""The page's stop: nothing that the page asks, or does not read, holds it up, and nothing that it asks ends its way."""

import asyncio
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
from aiohttp.test_utils import TestClient
from hypothesis import given
from hypothesis import strategies as st
from test_server import Bus, said, talk

from laptop.view import server
from laptop.view.actions.control import ANSWER_S, ENOUGH, Control
from laptop.view.actions.simulated_actions import SimulatedActions
from laptop.view.feeds.feed import SimulationFeed
from laptop.view.feeds.picture import Picture
from laptop.view.questions import MAX_WAITING, Questions, as_json
from swarm.errors import LocalError
from swarm.messages import Arm, Stop
from swarm.messages.codec import encode
from swarm.process.simulations import claim

LIVE = "/live?token=a-token"


@pytest.fixture
def feed(tmp_path: Path) -> Iterator[SimulationFeed]:
    directory = tmp_path / "run"
    with claim(directory):
        feed = SimulationFeed(directory, ())
        feed.buses = {"r0": Bus(), "r1": Bus()}  # type: ignore[dict-item]
        yield feed
        feed.close()


def stops(feed: SimulationFeed) -> list[int]:
    """How many stops each robot's bus was given."""
    return [sum(isinstance(message, Stop) for _, message in bus.published) for bus in feed.buses.values()]  # type: ignore[attr-defined]


async def until(condition: Any) -> None:
    async with asyncio.timeout(60.0):
        while not condition():
            await asyncio.sleep(0.01)


def test_stop_overtakes_acts_that_hang_on_this_page_and_on_others(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    monkeypatch.setattr(
        "laptop.view.actions.simulated_actions.app_requests.request_app", lambda *_: go_on.wait(60.0) and "done"
    )

    async def act(client: TestClient) -> None:
        sockets = [await client.ws_connect(LIVE) for _ in range(40)]  # more than there are threads for acts
        try:
            for socket in sockets:
                for _ in range(3):
                    await socket.send_json({"do": {"act": "start", "app": "consensus"}})
            await sockets[0].send_json({"do": {"act": "stop"}})
            await until(lambda: stops(feed) == [1, 1])
            assert await said(sockets[0], "done") == "stop given to all robots"
        finally:
            go_on.set()

    talk(feed, act, allowed=True)


def test_stop_of_a_page_that_reads_nothing_is_given_behind_a_flood_of_questions(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "RATE", 500.0)
    for t in range(100):
        feed.picture.take("r0", "swarm/r0/app/x/own", encode({"k": t, "text": "x" * 60_000}), float(t))

    async def act(client: TestClient) -> None:
        socket = await client.ws_connect(LIVE, max_msg_size=0)
        for _ in range(3 * MAX_WAITING):  # 60 kB each, which nobody takes
            await socket.send_json({"look": {"t": 1e9}})
        await socket.send_json({"do": {"act": "stop"}})
        await until(lambda: stops(feed) == [1, 1])

    talk(feed, act, allowed=True)


def test_a_later_stop_holds_though_the_end_of_the_one_before_is_confirmed_meanwhile(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "arm"})
    for name in feed.buses:
        feed.picture.put(name, "mesh/stopped", {"stopped": False}, 0.0)
    newest = feed.picture.newest

    def interrupted(robot: str, topic: str) -> object:
        monkeypatch.setattr(feed.picture, "newest", newest)
        control.do({"act": "stop"})
        return newest(robot, topic)

    monkeypatch.setattr(feed.picture, "newest", interrupted)
    control.repeat()
    control.repeat()
    assert stops(feed) == [2, 2]
    assert all(isinstance(bus.published[-1][1], Stop) for bus in feed.buses.values())  # type: ignore[attr-defined]


def arms(feed: SimulationFeed) -> dict[str, list[float]]:
    """The age of each re-arm that a robot's bus was given."""
    return {name: [each.age for _, each in bus.published if isinstance(each, Arm)] for name, bus in feed.buses.items()}  # type: ignore[attr-defined]


def test_the_end_of_a_stop_is_repeated_with_its_age_and_not_for_ever(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that never answers must not make the page take back the stops that others give later."""
    now = 100.0
    monkeypatch.setattr("laptop.view.actions.control.elapsed", lambda: now)
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "arm"})
    feed.picture.put("r0", "mesh/stopped", {"stopped": False}, 0.0)
    now = 101.0
    control.repeat()
    assert arms(feed) == {"r0": [0.0], "r1": [0.0, 1.0]}
    feed.picture.put("r0", "mesh/stopped", {"stopped": True}, 0.0)  # by somebody else
    now = 102.0
    control.repeat()
    assert all(age == 2.0 for ages in arms(feed).values() for age in ages[1:] if age != 1.0), (
        "it takes back older stops only"
    )
    now = 100.0 + ANSWER_S + 0.1
    control.repeat()
    given = arms(feed)
    now += 100.0
    control.repeat()
    assert arms(feed) == given
    told = [str(event) for event in feed.picture.events_since(0) if "taken back: arm again" in str(event)]
    assert len(told) == 1, "the page says once who has not answered"
    assert "r1" in told[0]


def test_the_end_of_a_stop_is_not_repeated_after_a_sleep_of_the_laptop(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its monotonic clock stands still meanwhile, and others may have given stops."""
    monkeypatch.setattr("swarm.clock.time.clock_gettime", lambda _: 100.0)
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "arm"})
    given = arms(feed)
    monkeypatch.setattr("swarm.clock.time.clock_gettime", lambda _: 700.0)
    control.repeat()
    assert arms(feed) == given


def test_the_end_of_a_stop_takes_back_what_the_page_showed_and_none_that_came_while_it_was_under_way(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This program may have hung."""
    monkeypatch.setattr(feed, "now", lambda: 50.0)
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "arm", "t": 48.0})
    assert [round(age) for ages in arms(feed).values() for age in ages] == [2, 2]
    with pytest.raises(LocalError, match=r"asked 30 s ago, .*: arm again"):
        control.do({"act": "arm", "t": 20.0})
    assert len(arms(feed)["r0"]) == 1
    control.do({"act": "arm", "t": 60.0})
    assert round(arms(feed)["r0"][-1]) == 0, "of a page that was told of a later time than there is"


def test_a_stop_names_the_robots_that_are_not_reached_yet(feed: SimulationFeed) -> None:
    late_r1(feed)
    control: Any = feed.control  # type: ignore[attr-defined]
    assert control.do({"act": "stop"}) == "stop given to all robots, as yet not to r1: they are not reached"


class Narrow(Bus):
    """A way that takes no large messages."""

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        if len(str(message)) > 1000:
            raise LocalError("too large")
        super().publish(key, message)


def test_a_parameter_that_the_way_does_not_take_ends_no_stop(feed: SimulationFeed) -> None:
    feed.buses = {"r0": Narrow(), "r1": Narrow()}  # type: ignore[dict-item]
    control = Control(feed, SimulatedActions(feed))
    with pytest.raises(LocalError, match="too large"):
        control.do({"act": "set", "app": "x", "name": "gain", "value": "x" * 2000})
    control.do({"act": "stop"})
    control.repeat()
    control.repeat()
    assert stops(feed) == [3, 3]


def test_stop_is_repeated_by_the_server_though_something_else_fails_there(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = []

    def fail(_: Control) -> None:
        failed.append(True)
        raise RuntimeError("a defect")

    monkeypatch.setattr(Control, "_ask_again", fail)

    async def main() -> None:
        ended = asyncio.Event()

        async def ready(_: str) -> None:
            control.do({"act": "stop"})

        control = Control(feed, SimulatedActions(feed))
        serving = asyncio.create_task(server.serve(feed, control, 0, ready, ended))
        await until(lambda: min(stops(feed)) >= 3 and len(failed) >= 2)
        ended.set()
        await serving

    asyncio.run(main())


QUESTIONS = [
    "do",
    "pace",
    "series",
    "fields",
    "look",
    "layout",
    "name",
    "panels",
    "act",
    "robot",
    "topic",
    "speed",
    "t",
]
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                [
                    "do",
                    "pace",
                    "series",
                    "fields",
                    "look",
                    "layout",
                    "name",
                    "panels",
                    "act",
                    "robot",
                    "topic",
                    "speed",
                    "paused",
                    "t",
                ]
            )
            | st.text(max_size=3),
            inner,
            max_size=3,
        )
    ),
    max_leaves=8,
)


@given(ANYTHING)
def test_whatever_a_page_asks_is_answered(asked: object) -> None:
    class Feed:
        picture = Picture()
        lock = threading.Lock()
        buses: ClassVar[dict[str, Bus]] = {}
        config = None

        def set_pace(self, speed: float | None, paused: bool) -> None:
            pass

    feed: Any = Feed()
    layouts = server.Layouts(Path("/proc/nowhere/view.json"))
    answer = server._answer(feed, Control(feed, None), layouts, asked)
    assert len(answer) == 1
    assert "defect" not in str(answer)
    json.dumps(answer, allow_nan=False)


@pytest.mark.parametrize(
    "text",
    [
        '{"pace":{"speed":1' + "0" * 400 + ',"paused":false}}',
        '{"pace":{"speed":1e999,"paused":false}}',
        '{"pace":{"speed":NaN,"paused":false}}',
        '{"pace":{"speed":-Infinity,"paused":false}}',
        '{"pace":{"speed":"nan","paused":false}}',
        "[" * 4000,
        '{"do":' * 600,
        '{"do":{"act":"push","robot":"r0","impulse":1' + "0" * 400 + "}}",
        '{"do":{"act":"set","app":"x","name":"gain","value":"\\ud800"}}',
        '{"do":{"act":["stop"]}}',
        '{"series":{"topic":"\\ud800","fields":[]}}',
        "1" * 4000,
    ],
)
def test_no_json_ends_the_socket_of_a_page(feed: SimulationFeed, text: str) -> None:
    async def act(client: TestClient) -> None:
        socket = await client.ws_connect(LIVE)
        await socket.send_str(text)
        assert await said(socket, "refused")
        await socket.send_json({"do": {"act": "stop"}})
        assert await said(socket, "done") == "stop given to all robots"
        assert stops(feed) == [1, 1]

    talk(feed, act, allowed=True)


def test_a_stop_does_not_wait_for_a_large_answer(feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped, as_text = threading.Event(), server.as_json

    def slow(answer: dict[str, Any]) -> str:
        assert "look" not in answer or stopped.wait(60.0)
        return as_text(answer)

    monkeypatch.setattr(server, "as_json", slow)

    async def act(client: TestClient) -> None:
        socket = await client.ws_connect(LIVE)
        await socket.send_json({"look": {"t": 0.0}})
        await socket.send_json({"do": {"act": "stop"}})
        assert await said(socket, "done") == "stop given to all robots"
        stopped.set()
        assert (await said(socket, "look"))["t"] == 0.0

    talk(feed, act, allowed=True)


def test_questions_beyond_the_bound_are_refused_and_answers_that_nobody_reads_are_dropped() -> None:
    async def main() -> None:
        async def answer(asked: object) -> str:
            return as_json({"done": str(asked)})

        sent: list[str] = []

        async def send(text: str) -> None:
            sent.append(text)

        questions = Questions(answer, answer, send)
        for number in range(2 * MAX_WAITING):
            await questions.take(number)
        for _ in range(2 * MAX_WAITING):
            await questions.take({"do": {"act": "stop"}})
        running = asyncio.create_task(questions.run())
        await until(lambda: f'{{"done":"{MAX_WAITING - 1}"}}' in sent)
        assert sum("refused" in text for text in sent) == MAX_WAITING
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(main())


def test_a_stop_is_repeated_to_those_alone_that_have_not_confirmed_it(feed: SimulationFeed) -> None:
    """Somebody may arm the others from elsewhere, while one robot is switched off."""
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "stop"})
    feed.picture.put("r0", "mesh/stopped", {"stopped": True}, 0.0)
    control.repeat()
    assert stops(feed) == [1, 2]
    feed.picture.put("r0", "mesh/stopped", {"stopped": False}, 0.0)
    control.repeat()
    assert stops(feed) == [1, 3]


def say(feed: SimulationFeed, robot: str, *stopped: bool) -> None:
    """Let a robot say so, while the page looks five times a second."""
    control: Any = feed.control  # type: ignore[attr-defined]
    for each in stopped:
        feed.picture.put(robot, "mesh/stopped", {"stopped": each}, 0.0)
        for _ in range(5):
            control.repeat()


def late_r1(feed: SimulationFeed) -> Any:
    """Give a stop while r1 is switched off; returns r1's bus."""
    feed.control = Control(feed, SimulatedActions(feed))  # type: ignore[attr-defined]
    away: Any = feed.buses["r1"]
    away.connected = False
    feed.control.do({"act": "stop"})  # type: ignore[attr-defined]
    return away


def comes_on(feed: SimulationFeed, bus: Any) -> int:
    """How many stops a robot is given that is switched on now."""
    bus.connected = True
    before = len(bus.published)
    feed.control.repeat()  # type: ignore[attr-defined]
    return len(bus.published) - before


def test_a_stop_that_somebody_else_has_taken_back_is_not_given_to_a_robot_that_comes_later(
    feed: SimulationFeed,
) -> None:
    """On one robot's bus it would stop all of them again."""
    r1 = late_r1(feed)
    say(feed, "r0", True, True, False, False)
    assert comes_on(feed, r1) == 0


def test_a_stop_is_not_given_up_for_what_a_robot_said_before_the_stop_reached_it(feed: SimulationFeed) -> None:
    """Somebody else's re-arm was under way."""
    r1 = late_r1(feed)
    say(feed, "r0", False, False, True, False, True, True)
    assert comes_on(feed, r1) == 1


def test_a_stop_is_not_given_up_when_a_robot_that_has_confirmed_it_was_switched_off(feed: SimulationFeed) -> None:
    """It comes back without the stop until a neighbour tells it."""
    r1 = late_r1(feed)
    say(feed, "r0", True)
    feed.buses["r0"].connected = False  # type: ignore[misc]
    say(feed, "r0", True)
    feed.buses["r0"].connected = True  # type: ignore[misc]
    say(feed, "r0", False, False, False)
    assert comes_on(feed, r1) == 1


def test_a_repeated_stop_does_not_wait_for_acts_that_hang(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    async def main() -> None:
        ended = asyncio.Event()

        async def ready(_: str) -> None:
            for _ in range(40):  # more than there are threads for acts
                hanging.append(asyncio.get_running_loop().run_in_executor(None, go_on.wait, 60.0))
            control.do({"act": "stop"})

        hanging: list[asyncio.Future[bool]] = []
        control = Control(feed, SimulatedActions(feed))
        serving = asyncio.create_task(server.serve(feed, control, 0, ready, ended))
        try:
            await until(lambda: min(stops(feed)) >= 3)
        finally:
            go_on.set()
        ended.set()
        await serving

    asyncio.run(main())


def test_what_a_robot_has_said_before_a_stop_confirms_it_only_after_repetitions(feed: SimulationFeed) -> None:
    """It may have been armed since, and its tunnel may have lost both that news and the stop."""
    for name in feed.buses:
        feed.picture.put(name, "mesh/stopped", {"stopped": True}, 0.0)
    away: Any = feed.buses["r1"]
    away.connected = False
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "stop"})
    for _ in range(20):
        control.repeat()
    assert stops(feed) == [ENOUGH, 21]
    away.connected = True
    for _ in range(20):
        control.repeat()
    assert stops(feed) == [ENOUGH, 21 + ENOUGH]


def test_a_stop_does_not_wait_until_all_that_a_robot_says_is_taken_apart(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    since = feed.picture.since
    monkeypatch.setattr(feed.picture, "since", lambda *arguments: go_on.wait(60.0) and since(*arguments))

    async def act(client: TestClient) -> None:
        socket = await client.ws_connect(LIVE)
        try:
            await socket.send_json({"do": {"act": "stop"}})
            await until(lambda: stops(feed) == [1, 1])
        finally:
            go_on.set()

    talk(feed, act, allowed=True)
