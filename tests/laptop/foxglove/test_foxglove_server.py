"""An independent client of Foxglove's WebSocket protocol (foxglove.sdk.v1) sees the swarm."""

import asyncio
import json
import re
import struct
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
import aiohttp
from conftest import wait_until

from laptop.foxglove.server import FoxgloveServer
from laptop.view.actions.control import Control
from laptop.view.feeds.picture import Picture
from swarm.config import parse
from swarm.config.example import EXAMPLE
from swarm.errors import LocalError
from swarm.messages import AppParameter, AppParameters, Pose, SetAppParameters
from swarm.messages.codec import encode

HEAD = struct.Struct("<BIQ")
"""Of a message: opcode 1, subscription, log time in ns."""
UNKNOWN = re.compile(r"Unknown channel ID: (\d+)")


class Bus:
    connected = True

    def __init__(self) -> None:
        self.published: list[tuple[str, object]] = []

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        self.published.append((key, message))


class Feed:
    """A swarm of which a pose and an app's parameters are known."""

    kind = "simulation"
    live = True

    def __init__(self) -> None:
        self.picture = Picture()
        self.lock = threading.Lock()
        self.config = parse(EXAMPLE, Path("swarm.toml"))
        self.buses = {"r0": Bus()}
        step = AppParameter(0.5, "1", "a number", live=True)
        self.tell("dwm/pose", Pose(1.0, 1, 1.5, 2.0, 0.0, 90, "ekf"))
        self.tell("app/mine/parameters", AppParameters(1.0, {"step_size": step}))

    def tell(self, topic: str, message: object) -> None:
        with self.lock:
            self.picture.take("r0", f"swarm/r0/{topic}", encode(message), 1.0)

    def now(self) -> float:
        return 1.0

    def check_control(self) -> None:
        pass


class Actions:
    acts: ClassVar[dict[str, Any]] = {}

    def give(self, robots: Any, app: str, values: Any) -> list[str]:
        return []

    def close(self) -> None:
        pass


@pytest.fixture
def feed() -> Feed:
    return Feed()


@pytest.fixture(params=[True])
def served(feed: Feed, request: pytest.FixtureRequest) -> Iterator[FoxgloveServer]:
    control = Control(feed, Actions() if request.param else None)  # type: ignore[arg-type]
    server = FoxgloveServer(feed, control, 0, writable=request.param)  # type: ignore[arg-type]
    yield server
    server.close()


class Client:
    """What the server has said."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self.channels: dict[int, dict[str, Any]] = {}
        self.newest: dict[str, Any] = {}
        self.said: dict[str, Any] = {}

    async def hear(self) -> None:
        message = await self._socket.receive(timeout=60)
        if message.type == aiohttp.WSMsgType.BINARY:
            opcode, subscription, _ = HEAD.unpack_from(message.data)
            assert opcode == 1
            self.newest[self.channels[subscription]["topic"]] = json.loads(message.data[HEAD.size :])
            return
        value = json.loads(message.data)
        self.said[value["op"]] = value
        if value["op"] == "advertise":
            self.channels |= {channel["id"]: channel for channel in value["channels"]}
            await self._subscribe(channel["id"] for channel in value["channels"])
        elif value["op"] == "status" and (unknown := UNKNOWN.search(value["message"])):
            # The SDK 0.30 advertises a new channel before it takes subscriptions to it.
            await self._subscribe([int(unknown[1])])

    async def _subscribe(self, channels: Iterable[int]) -> None:
        wanted = [{"id": channel, "channelId": channel} for channel in channels]
        await self._socket.send_json({"op": "subscribe", "subscriptions": wanted})


def talk(port: int, act: Any) -> None:
    async def main() -> None:
        address = f"ws://127.0.0.1:{port}"
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(address, protocols=["foxglove.sdk.v1"]) as socket,
        ):
            await act(Client(socket), socket)

    asyncio.run(main())


def test_a_client_that_comes_late_is_told_what_was_said_before(served: FoxgloveServer) -> None:
    async def look(client: Client, _: Any) -> None:
        while not {"swarm/r0/dwm/pose", "/scene", "/tf", "swarm/r0/app/mine/parameters"} <= client.newest.keys():
            await client.hear()
        assert client.newest["swarm/r0/dwm/pose"]["pose"]["position"] == {"x": 1.5, "y": 2.0, "z": 0.0}
        assert "r0" in [entity["id"] for entity in client.newest["/scene"]["entities"]]
        by_topic = {channel["topic"]: channel for channel in client.channels.values()}
        assert by_topic["/scene"]["schemaName"] == "foxglove.SceneUpdate"
        assert {channel["encoding"] for channel in client.channels.values()} == {"json"}
        assert json.loads(by_topic["swarm/r0/dwm/pose"]["schema"])["title"] == "foxglove.PoseInFrame"

    talk(served.port, look)
    talk(served.port, look)


def test_a_step_that_fails_does_not_end_those_after_it(
    served: FoxgloveServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_: int) -> list[str]:
        raise KeyError("a defect")

    with monkeypatch.context() as patched:
        patched.setattr(served, "_look", fail)
        wait_until(lambda: "a step for Foxglove has failed" in caplog.text)

    async def look(client: Client, _: Any) -> None:
        while "swarm/r0/dwm/pose" not in client.newest:
            await client.hear()

    talk(served.port, look)


def test_a_parameter_that_a_client_sets_is_asked_of_the_app(served: FoxgloveServer, feed: Feed) -> None:
    async def set_it(client: Client, socket: Any) -> None:
        await socket.send_json({"op": "getParameters", "parameterNames": [], "id": "all"})
        while "parameterValues" not in client.said:
            await client.hear()
        (known,) = client.said.pop("parameterValues")["parameters"]
        assert (known["name"], known["value"]) == ("r0.mine.step_size", 0.5)
        parameters = [{"name": "r0.mine.step_size", "value": 0.25, "type": "float64"}, {"name": "nonsense", "value": 1}]
        await socket.send_json({"op": "setParameters", "parameters": parameters, "id": "set"})
        while "parameterValues" not in client.said:
            await client.hear()

    talk(served.port, set_it)
    key, asked = feed.buses["r0"].published[0]
    assert key == "swarm/r0/app/mine/set/parameters"
    assert isinstance(asked, SetAppParameters)
    assert asked.parameters == {"step_size": 0.25}


@pytest.mark.parametrize("served", [False], indirect=True)
def test_without_control_no_parameter_is_set(served: FoxgloveServer, feed: Feed) -> None:
    async def set_it(client: Client, socket: Any) -> None:
        parameters = [{"name": "r0.mine.step_size", "value": 0.25, "type": "float64"}]
        await socket.send_json({"op": "setParameters", "parameters": parameters, "id": "set"})
        while "parameterValues" not in client.said:
            await client.hear()

    talk(served.port, set_it)
    assert feed.buses["r0"].published == []


def test_a_port_that_is_taken_is_named(served: FoxgloveServer, feed: Feed) -> None:
    with pytest.raises(LocalError, match="--port"):
        FoxgloveServer(feed, Control(feed, None), served.port, writable=False)  # type: ignore[arg-type]
