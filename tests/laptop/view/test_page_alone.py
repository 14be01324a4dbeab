"""The page in a real browser before a server of the test: robots say odd things, the server goes and comes back."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
from browsing import PATIENCE_MS, row, until

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
expect = sync_api.expect

from conftest import wait_until  # noqa: E402
from test_page_stop import stops  # noqa: E402
from test_reach import CONFIG  # noqa: E402
from test_server import Bus  # noqa: E402

from laptop.view import server  # noqa: E402
from laptop.view.actions.control import Control  # noqa: E402
from laptop.view.actions.simulated_actions import SimulatedActions  # noqa: E402
from laptop.view.feeds.feed import SimulationFeed  # noqa: E402
from swarm.config import parse  # noqa: E402
from swarm.messages import topics  # noqa: E402
from swarm.process.simulations import claim  # noqa: E402

pytest_plugins = ("view_fixtures",)
pytestmark = [pytest.mark.slow, pytest.mark.timeout(240), pytest.mark.filterwarnings("ignore::ResourceWarning")]


class Server:
    """The page's server, in a thread of ours."""

    def __init__(self, feed: SimulationFeed, port: int) -> None:
        self.address = ""
        self._feed, self._port = feed, port
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        assert self._ready.wait(60.0)

    async def _serve(self) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()

        async def ready(address: str) -> None:
            self.address = address
            self._ready.set()

        await server.serve(
            self._feed, Control(self._feed, SimulatedActions(self._feed)), self._port, ready, self._ended
        )

    def close(self) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join()


@pytest.fixture
def feed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SimulationFeed]:
    monkeypatch.setattr(server.secrets, "token_urlsafe", lambda _: "a-token")
    directory = tmp_path / "run"
    with claim(directory):
        feed = SimulationFeed(directory)
        feed.buses = {name: Bus() for name in ("r0", "r1", "r2")}  # type: ignore[misc]
        feed.config = parse(CONFIG, Path("swarm.toml"))
        yield feed
        feed.close()


@pytest.fixture
def port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@pytest.fixture
def page(browser: Any) -> Iterator[tuple[Any, list[str]]]:
    page, problems = browser.new_page(), list[str]()
    page.on("pageerror", lambda error: problems.append(str(error)))
    yield page, problems
    page.close()


def test_a_stop_that_is_pressed_while_the_server_is_away_goes_out_when_it_is_back(
    feed: SimulationFeed, port: int, page: tuple[Any, list[str]]
) -> None:
    shown, problems = page
    first = Server(feed, port)
    shown.goto(first.address)
    expect(shown.locator("#stop")).to_be_visible(timeout=PATIENCE_MS)
    first.close()
    expect(shown.locator("#connection")).to_have_text("server lost", timeout=PATIENCE_MS)
    shown.locator("#stop").click()
    expect(shown.locator("#said")).to_contain_text("NOT SENT")
    assert stops(feed) == [0, 0, 0]
    second = Server(feed, port)
    try:
        wait_until(lambda: min(stops(feed)) >= 1)
        expect(shown.locator("#said")).to_have_text("stop given to all robots", timeout=PATIENCE_MS)
    finally:
        second.close()
    assert problems == []


ODD = [5, None, "x", [], [5], [{}], {}, {"a": {}}, [[[]]], 1e300, -1, True, "\x1b[31m<b>"]


def test_nothing_that_a_robot_says_breaks_the_page_or_hides_its_stop(
    feed: SimulationFeed, port: int, page: tuple[Any, list[str]]
) -> None:
    """r1 puts something odd into each field of each key in turn; r0 goes on to be shown."""
    shown, problems = page
    serving = Server(feed, port)
    try:
        shown.goto(serving.address)
        row(shown, "r1").click(timeout=PATIENCE_MS)
        for number, odd in enumerate(ODD):
            with feed.lock:
                for (service, topic), kind in topics().items():
                    key = f"swarm/r1/{service}/{topic}".replace("*", "x")
                    fields = list(kind.__dataclass_fields__)  # type: ignore[attr-defined]
                    for message in ({}, odd, dict.fromkeys(fields, odd), {"k": number, "t": odd}):
                        feed.picture.take("r1", key, msgpack.packb(message), float(number))
                    for name in fields:
                        feed.picture.take("r1", f"{key}", msgpack.packb({name: odd}), float(number))
                feed.picture.put("r0", "app/x/state", {"t": float(number), "k": number, "state": {}}, float(number))
            until(shown, f"swarmView.store.get('r0', 'app/x/state')?.k === {number}")
            shown.wait_for_timeout(300)  # a round of all panels
        expect(row(shown, "r0")).to_contain_text("x", timeout=PATIENCE_MS)
        shown.locator("#stop").click()
        wait_until(lambda: min(stops(feed)) >= 1)
    finally:
        serving.close()
    assert problems == []
