"""Who gets the page, and what it is told."""

import argparse
import asyncio
import json
import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
from aiohttp import WSServerHandshakeError
from aiohttp.test_utils import TestClient, TestServer
from conftest import wait_until

from laptop.cli import main
from laptop.view import live, server
from laptop.view.actions.control import ANSWER_S, DRIVE_S, Control
from laptop.view.actions.simulated_actions import SimulatedActions
from laptop.view.feeds import feed as feeds
from laptop.view.feeds.feed import _LOOK_EVERY, SimulationFeed
from laptop.view.server import application
from swarm.errors import LocalError
from swarm.messages import SetMode, SetVelocity, Status
from swarm.messages.codec import encode
from swarm.process.simulations import CONFIG, claim

TOKEN = "a-token"


class Bus:
    """What is published ends here."""

    connected = True

    def __init__(self) -> None:
        self.published: list[tuple[str, object]] = []

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        self.published.append((key, message))

    def close(self) -> None:
        pass


@pytest.fixture
def feed(tmp_path: Path):
    directory = tmp_path / "run"
    with claim(directory):
        feed = SimulationFeed(directory, ())
        feed.buses = {"r0": Bus(), "r1": Bus()}
        yield feed
        feed.close()


def test_the_page_of_a_simulation_follows_the_next_run_in_its_directory(feed: SimulationFeed) -> None:
    def begin(*names: str) -> None:
        table = "".join(f'[[robots]]\nname = "{name}"\nlink = "sim:/tmp/{name}"\n' for name in names)
        (feed.directory / CONFIG).write_text(f'network = "x"\ntopology = "auto"\n[mesh]\ninsecure = true\n{table}')

    begin("r0", "r1")
    wait_until(lambda: feed.config is not None and feed.config.names == ("r0", "r1"))
    feed.buses["r2"] = Bus()
    begin("r1", "r2")
    wait_until(lambda: feed.config.names == ("r1", "r2"))
    wait_until(lambda: sorted(feed.buses) == ["r1", "r2"])
    (feed.directory / CONFIG).unlink()  # between two runs the page keeps what it has
    time.sleep(2 * _LOOK_EVERY)
    assert feed.config.names == ("r1", "r2")


def test_a_look_that_fails_is_logged_and_the_next_one_sees_what_has_changed(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    looks: list[Path] = []

    def look(directory: Path) -> bool:
        looks.append(directory)
        if len(looks) == 1:
            raise TypeError("a defect")
        return False

    monkeypatch.setattr(feeds, "is_live", look)
    wait_until(lambda: not feed.live)
    assert caplog.text.count("a look at the simulation has failed") == 1


def talk(feed: SimulationFeed, act: Any, *, allowed: bool = False) -> None:
    """Run `act(client)` against a server of the feed."""

    async def main() -> None:
        async with TestClient(
            TestServer(
                application(feed, Control(feed, SimulatedActions(feed) if allowed else None), TOKEN), host="127.0.0.1"
            )
        ) as client:
            await act(client)

    asyncio.run(main())


async def said(socket: Any, name: str) -> Any:
    """The next message that has this field."""
    while True:
        message = await socket.receive_json(timeout=60)
        if name in message:
            return message[name]


def test_the_page_needs_the_token_and_loads_nothing_from_elsewhere(feed: SimulationFeed) -> None:
    async def act(client: TestClient) -> None:
        for query in ({}, {"token": "another"}):
            assert (await client.get("/", params=query)).status == 403
            assert (await client.get("/live", params=query)).status == 403
        page = await client.get("/", params={"token": TOKEN})
        assert page.status == 200
        assert "default-src 'self'" in page.headers["Content-Security-Policy"]
        text = await page.text()
        assert "http" not in text
        for part in ("main.js", "map/map.js", "style.css", "vendor/uPlot.iife.min.js"):
            assert (await client.get(f"/page/{part}")).status == 200

    talk(feed, act)


@pytest.mark.parametrize("headers", [{"Origin": "http://evil.example"}, {"Host": "evil.example"}, {"Origin": "null"}])
def test_other_origins_are_refused(feed: SimulationFeed, headers: dict[str, str]) -> None:
    async def act(client: TestClient) -> None:
        assert (await client.get("/", params={"token": TOKEN}, headers=headers)).status == 403
        with pytest.raises(WSServerHandshakeError, match="403"):
            await client.ws_connect("/live?token=" + TOKEN, headers=headers)

    talk(feed, act)


def test_a_page_gets_all_first_and_then_what_changes_and_two_of_them_do_not_disturb_each_other(
    feed: SimulationFeed,
) -> None:
    status = encode(Status(1.0, "mesh", "ready", "", 1, 0.0, {}))
    feed.picture.take("r0", "swarm/r0/mesh/status", status, 0.0)

    async def act(client: TestClient) -> None:
        one = await client.ws_connect("/live?token=" + TOKEN)
        assert set(await said(one, "robots")) == {"r0"}
        two = await client.ws_connect("/live?token=" + TOKEN)
        assert set(await said(two, "robots")) == {"r0"}
        with feed.lock:
            feed.picture.take("r1", "swarm/r1/mesh/status", status, 0.0)
        assert set(await said(one, "robots")) == {"r1"}
        assert set(await said(two, "robots")) == {"r1"}
        await one.close()
        with feed.lock:
            feed.picture.take("r0", "swarm/r0/mesh/status", status, 0.0)
        assert set(await said(two, "robots")) == {"r0"}

    talk(feed, act)


def test_a_page_may_ask_for_the_history_of_a_key(feed: SimulationFeed) -> None:
    for t in range(3):
        feed.picture.take("r0", "swarm/r0/balancer/state", encode({"tilt": 0.1 * t}), float(t))

    async def act(client: TestClient) -> None:
        socket = await client.ws_connect("/live?token=" + TOKEN)
        await socket.send_json({"series": {"topic": "balancer/state", "fields": [["tilt"]]}})
        rows = (await said(socket, "series"))["rows"]["r0"]
        assert [t for t, *_ in rows] == [0.0, 1.0, 2.0]

    talk(feed, act)


@pytest.mark.parametrize("text", ["", "[]", "1", "null", '{"series": 3}', '{"do": 3}', "{}", '"' + "x" * 100 + '"'])
def test_what_is_no_question_is_refused_and_the_page_lives_on(feed: SimulationFeed, text: str) -> None:
    async def act(client: TestClient) -> None:
        socket = await client.ws_connect("/live?token=" + TOKEN)
        await socket.send_str(text)
        assert await said(socket, "refused")
        assert await said(socket, "t") >= 0.0

    talk(feed, act, allowed=True)


def test_without_control_every_act_is_refused(feed: SimulationFeed) -> None:
    async def act(client: TestClient) -> None:
        socket = await client.ws_connect("/live?token=" + TOKEN)
        for name in ("stop", "arm", "press", "push", "lay", "kill", "cut", "set", "start", "end"):
            await socket.send_str(json.dumps({"do": {"act": name, "robot": "r0"}}))
            assert "--control" in await said(socket, "refused")
        assert all(not bus.published for bus in feed.buses.values())

    talk(feed, act)


def test_a_stop_is_given_again_until_every_robot_has_confirmed_it(feed: SimulationFeed) -> None:
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "stop"})
    feed.picture.put("r0", "mesh/stopped", {"stopped": True}, 0.0)
    control.repeat()
    assert [len(bus.published) for bus in feed.buses.values()] == [1, 2]
    feed.picture.put("r1", "mesh/stopped", {"stopped": True}, 0.0)
    control.repeat()
    control.repeat()
    assert [len(bus.published) for bus in feed.buses.values()] == [1, 2]
    assert {key for key, _ in feed.buses["r1"].published} == {"swarm/stop"}
    control.do({"act": "arm"})
    assert feed.buses["r0"].published[-1][0] == "swarm/r0/mesh/set/arm"


@pytest.mark.parametrize(
    ("act", "said"),
    [
        ({"act": "press", "robot": "r9", "button": "A"}, "no robot"),
        ({"act": "press", "robot": "r0", "button": "Z"}, "no button"),
        ({"act": "push", "robot": "r0", "impulse": "hard"}, "push"),
        ({"act": "push", "robot": "r0", "impulse": 99}, "impulse"),
        ({"act": "lay", "robot": "r0"}, "lay"),
        ({"act": "kill", "robot": "r0", "service": "../x"}, "no service"),
        ({"act": "kill", "robot": "r0", "service": "mesh"}, "not running"),
        ({"act": "cut", "robot": "r0", "peer": "r1", "seconds": 1e9}, "600"),
        ({"act": "cut", "robot": "r0", "peer": "r1", "seconds": 1}, "cut"),
        ({"act": "set", "app": "a/b", "name": "x", "value": 1}, "app"),
        ({"act": "start", "app": "consensus"}, "takes no orders"),
        ({"act": "start", "app": "../x"}, "no name of an app"),
        ({"act": "end", "app": "consensus", "robot": "r9"}, "no robot"),
        ({"act": "start", "app": "x", "settings": {"a b": 1}}, "name of a parameter"),
        ({"act": "start", "app": "x", "settings": [1]}, "settings"),
        ({"act": "start", "app": "x", "settings": {"r9.gain": 1}}, "the robots are r0, r1"),
        ({"act": "end"}, "app"),
        ({"act": "fly"}, "expected an act"),
        ("stop", "expected an act"),
    ],
)
def test_bad_acts_are_refused_in_words(feed: SimulationFeed, act: object, said: str) -> None:
    with pytest.raises(LocalError, match=said):
        Control(feed, SimulatedActions(feed)).do(act)


def test_a_parameter_is_set_on_all_robots_or_on_one(feed: SimulationFeed) -> None:
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "set", "app": "x", "name": "gain", "value": 0.5})
    control.do({"act": "set", "app": "x", "name": "gain", "value": 0.5, "robot": "r1"})
    assert [len(bus.published) for bus in feed.buses.values()] == [1, 2]
    key, message = feed.buses["r1"].published[0]
    assert key == "swarm/r1/app/x/set/parameters"
    assert message.parameters == {"gain": 0.5}


def test_an_app_starts_with_its_parameters_and_is_asked_for_them_in_case_it_goes_on(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []
    monkeypatch.setattr(
        "laptop.view.actions.simulated_actions.app_requests.request_app", lambda *order: given.append(order)
    )
    control, asked = Control(feed, SimulatedActions(feed)), {"act": "start", "app": "goto"}
    control.do(asked | {"settings": {"waypoints": "stay", "r1.waypoints": "1,0.5 stay"}})
    settings = ["waypoints=stay", "r1.waypoints=1,0.5 stay"]
    assert given == [(feed.directory, "start", "goto", ["r0", "r1"], settings)]
    published = [feed.buses[name].published[0] for name in ("r0", "r1")]
    assert [key for key, _ in published] == [f"swarm/{name}/app/goto/set/parameters" for name in ("r0", "r1")]
    assert [message.parameters["waypoints"] for _, message in published] == ["stay", "1,0.5 stay"]
    feed.buses["r1"].connected = False
    with pytest.raises(LocalError, match="r1 cannot be given parameters"):
        control.do(asked | {"settings": {"waypoints": "0,0"}})
    control.do(asked)
    assert given[1:] == [(feed.directory, "start", "goto", ["r0", "r1"], [])]


def test_parameters_that_an_earlier_start_left_unanswered_are_not_asked_of_a_later_start(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("laptop.view.actions.simulated_actions.app_requests.request_app", lambda *_: "started")
    control, start = Control(feed, SimulatedActions(feed)), {"act": "start", "app": "goto"}
    control.do(start | {"settings": {"wrong": 1}})
    control.do(start | {"settings": {"speed": 0.1}})
    control.do({"act": "set", "app": "goto", "name": "gain", "value": 2, "robot": "r0"})
    said = [[message.parameters for _, message in bus.published] for bus in feed.buses.values()]
    assert said == [[{"wrong": 1}, {"speed": 0.1}, {"speed": 0.1, "gain": 2}], [{"wrong": 1}, {"speed": 0.1}]]
    control.do(start | {"robot": "r0"})
    control.repeat()
    assert [len(bus.published) for bus in feed.buses.values()] == [3, 3]


def test_of_robots_that_are_not_reached_it_is_said_that_they_keep_their_parameters(feed: SimulationFeed) -> None:
    control, asked = Control(feed, SimulatedActions(feed)), {"act": "set", "app": "x", "name": "gain", "value": 0.5}
    feed.config = SimpleNamespace(names=("r0", "r1", "r2"))
    assert control.do(asked) == "x: gain=0.5 asked of r0 r1, not of r2: they are not reached"
    feed.buses["r0"].connected = False
    assert control.do(asked).endswith("asked of r1, not of r0 r2: they are not reached")
    assert not feed.buses["r0"].published[1:]
    with pytest.raises(LocalError, match="r0 is not reached"):
        control.do(asked | {"robot": "r0"})


def test_an_app_is_asked_again_until_it_answers_or_for_so_long(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("laptop.view.actions.control.clock.now", lambda: now[0])
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "set", "app": "x", "name": "gain", "value": 0.5})
    control.repeat()
    first, again = feed.buses["r0"].published
    assert first == again
    feed.picture.put("r0", "app/x/parameters_set", {"ticket": first[1].ticket, "problem": ""}, 0.0)
    control.repeat()
    assert [len(bus.published) for bus in feed.buses.values()] == [2, 3]
    now[0] += ANSWER_S + 0.1
    control.repeat()
    control.repeat()
    assert [len(bus.published) for bus in feed.buses.values()] == [2, 3]
    assert [(event.robot, event.text) for event in feed.picture.events] == [("r1", "app/x has not answered: gain=0.5")]


def test_without_a_simulation_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="no simulation is running"):
        SimulationFeed(tmp_path, ())


def test_a_number_that_is_none_is_told_as_text(feed: SimulationFeed) -> None:
    """NaN is no JSON: a browser would refuse the whole step."""
    for number in (math.nan, math.inf):
        payload = msgpack.packb({"x": number, "y": 1.0, "links": [{"peer": number, "state": number}]})
        for topic in ("dwm/pose", "mesh/links", "app/x/state", "app/x/progress"):
            feed.picture.take("r0", f"swarm/r0/{topic}", payload, 0.0)

    async def act(client: TestClient) -> None:
        socket = await client.ws_connect("/live?token=" + TOKEN)
        text = ""
        while '"robots"' not in text:
            text = await socket.receive_str(timeout=60)
        await socket.send_json({"look": {"t": 1e9}})
        while '"look"' not in text:
            text += await socket.receive_str(timeout=60)
        assert "NaN" not in text
        assert "Infinity" not in text
        assert '"x":"inf"' in text

    talk(feed, act)


def test_a_page_that_sleeps_costs_no_memory_and_is_up_to_date_when_it_returns(
    feed: SimulationFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "RATE", 500.0)
    steps, size = 300, 400_000  # 120 MB, if they were kept

    async def act(client: TestClient) -> None:
        socket = await client.ws_connect("/live?token=" + TOKEN, max_msg_size=0)
        for number in range(steps):
            with feed.lock:
                feed.picture.put("r0", "app/x/state", {"k": number, "text": "x" * size}, 0.0)
            await asyncio.sleep(0.004)
        received = 0
        while True:
            text = await socket.receive_str(timeout=60)
            received += len(text)
            step = json.loads(text)
            if step.get("robots", {}).get("r0", {}).get("app/x/state", {}).get("k") == steps - 1:
                break
        assert received < steps * size / 4  # what the kernel and this client hold
        await socket.close()

    talk(feed, act)


def test_the_command_says_that_there_is_nothing_to_see(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        (["--run-dir", str(tmp_path)], "no simulation is running"),
        ([str(tmp_path)], "no recording"),
        (["--robots", "r0", "--config", str(tmp_path / "none.toml")], "there is no such file"),
        (["--robots", "r0", str(tmp_path)], "a recording has all of its robots"),
        (["--config", str(tmp_path / "none.toml")], "there is no such file"),
        ([str(tmp_path), "--real"], "a recording has all of its robots"),
        ([str(tmp_path), "--control"], "nothing to control"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["view", "--no-open", *words])
        assert end.value.code == 2
        assert said in capsys.readouterr().err


def test_of_a_simulation_those_robots_are_watched_that_are_named(tmp_path: Path) -> None:
    with claim(tmp_path):
        (tmp_path / "swarm.toml").write_text("".join(f'[[robots]]\nname = "r{i}"\n' for i in range(3)))
        parser = argparse.ArgumentParser()
        live.add_arguments(parser)
        parser.set_defaults(control=False)
        named, control = live.open_feed(parser.parse_args(["--run-dir", str(tmp_path), "--robots", "r1"]))
        wait_until(lambda: named.buses)
        control.close()
        named.close()
        assert list(named.buses) == ["r1"]
        with pytest.raises(LocalError, match="no robot 'r7' in the simulation, there are r0, r1, r2"):
            live.open_feed(parser.parse_args(["--run-dir", str(tmp_path), "--robots", "r7"]))


def test_a_page_looks_back_at_an_instant_of_the_last_two_minutes(feed: SimulationFeed) -> None:
    for t in range(5):
        feed.picture.take("r0", "swarm/r0/sim/truth", encode({"t": float(t), "x": 0.1 * t, "y": 0.0}), float(t))
    feed.picture.note(3.5, "r0", "info", "late")

    async def act(client: TestClient) -> None:
        socket = await client.ws_connect("/live?token=" + TOKEN)
        await socket.send_json({"look": {"t": 2.5}})
        look = await said(socket, "look")
        assert look["robots"]["r0"]["sim/truth"]["x"] == pytest.approx(0.2)
        assert [x for x, _ in look["trails"]["r0"]] == pytest.approx([0.0, 0.1, 0.2])
        assert look["events"] == []
        await socket.send_json({"look": {"t": -1.0}})
        assert (await said(socket, "look"))["robots"] == {}

    talk(feed, act)


def test_robots_stand_rest_and_lie_all_or_one_of_them(feed: SimulationFeed) -> None:
    control = Control(feed, SimulatedActions(feed))
    assert control.do({"act": "mode", "mode": "stand"}) == "stand asked of r0 r1"
    assert control.do({"act": "mode", "mode": "lie", "robot": "r1"}) == "lie asked of r1"
    given = [(key, message) for bus in feed.buses.values() for key, message in bus.published]
    assert given == [
        ("swarm/r0/balancer/set/mode", SetMode("stand")),
        ("swarm/r1/balancer/set/mode", SetMode("stand")),
        ("swarm/r1/balancer/set/mode", SetMode("lie")),
    ]
    for wrong in ({}, {"mode": "fly"}, {"mode": "calibrate"}, {"mode": "rest", "robot": "r9"}):
        with pytest.raises(LocalError, match=r"mode|no robot"):
            control.do({"act": "mode"} | wrong)


def test_a_robot_drives_for_a_moment_and_no_faster_than_it_may(feed: SimulationFeed) -> None:
    control = Control(feed, SimulatedActions(feed))
    control.do({"act": "drive", "robot": "r1", "speed": 0.1, "turn": -1})
    assert feed.buses["r1"].published == [("swarm/r1/balancer/set/velocity", SetVelocity(0.1, -1.0, DRIVE_S))]
    for wrong in ({"speed": 9.0}, {"turn": math.nan}, {"speed": None}, {"robot": "r9"}, {"robot": None}):
        with pytest.raises(LocalError, match=r"drive|no robot"):
            control.do({"act": "drive", "robot": "r1", "speed": 0.0, "turn": 0.0} | wrong)
    assert len(feed.buses["r1"].published) == 1


def test_a_robot_is_put_no_further_than_a_place_can_be(feed: SimulationFeed) -> None:
    control = Control(feed, SimulatedActions(feed))
    for x in (1e9, math.nan, "x", None):
        with pytest.raises(LocalError, match="place"):
            control.do({"act": "place", "robot": "r0", "x": x, "y": 0.0})
