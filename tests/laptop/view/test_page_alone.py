"""The page in a real browser before a server of the test: robots say odd things, the server goes and comes back."""

import asyncio
import itertools
import re
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

from bench.rigs.ports import free_port  # noqa: E402
from laptop.view import server  # noqa: E402
from laptop.view.actions.control import Control  # noqa: E402
from laptop.view.actions.simulated_actions import SimulatedActions  # noqa: E402
from laptop.view.feeds.feed import SimulationFeed  # noqa: E402
from swarm.config import parse  # noqa: E402
from swarm.messages import topics  # noqa: E402
from swarm.messages.codec import encode  # noqa: E402
from swarm.process.simulations import claim  # noqa: E402

pytest_plugins = ("view_fixtures",)
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300), pytest.mark.filterwarnings("ignore::ResourceWarning")]


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
        feed = SimulationFeed(directory, ())
        feed.buses = {name: Bus() for name in ("r0", "r1", "r2")}  # type: ignore[misc]
        feed.config = parse(CONFIG, Path("swarm.toml"))
        yield feed
        feed.close()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def page(browser: Any) -> Iterator[tuple[Any, list[str]]]:
    page, problems = browser.new_page(), list[str]()
    page.on("pageerror", lambda error: problems.append(str(error)))
    yield page, problems
    page.close()


@pytest.fixture
def shown(feed: SimulationFeed, port: int, page: tuple[Any, list[str]]) -> Iterator[Any]:
    """The page of a server; it must have had no error in the end."""
    shown, problems = page
    serving = Server(feed, port)
    try:
        shown.goto(serving.address)
        yield shown
    finally:
        serving.close()
    assert problems == []


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


def test_the_stop_button_tells_what_holds_now_also_while_the_page_looks_back_and_without_a_server(
    feed: SimulationFeed, port: int, page: tuple[Any, list[str]]
) -> None:
    shown, problems = page
    stop, alive = shown.locator("#stop"), shown.locator("[data-answer=alive] b")
    names, t = feed.buses, feed.now()

    def say(stopped: bool) -> None:
        with feed.lock:
            for name in names:
                feed.picture.put(name, "mesh/stopped", {"stopped": stopped}, feed.now())

    with feed.lock:
        for name in names:  # with a history, which a look back finds
            feed.picture.take(name, f"swarm/{name}/mesh/stopped", encode({"t": t, "stopped": False, "by": {}}), t)
    serving = Server(feed, port)
    try:
        shown.goto(serving.address)
        expect(stop).to_have_text("STOP", timeout=PATIENCE_MS)
        stop.click()
        expect(stop).to_have_text("STOPPING 0/3", timeout=PATIENCE_MS)
        say(True)
        expect(stop).to_have_text("STOPPED 3/3", timeout=PATIENCE_MS)
        until(shown, f"swarmView.store.newest > {t}")
        shown.evaluate(f"swarmView.present.go({t})")
        until(shown, "swarmView.store.t === swarmView.present.wanted")
        expect(alive).to_have_text("3 of 3 stopped", timeout=PATIENCE_MS)
        expect(stop).to_have_text("STOPPED 3/3")
        say(False)
        expect(stop).to_have_text("STOP", timeout=PATIENCE_MS)
        say(True)
        expect(stop).to_have_text("STOPPED 3/3", timeout=PATIENCE_MS)
    finally:
        serving.close()
    expect(shown.locator("#connection")).to_have_text("server lost", timeout=PATIENCE_MS)
    expect(stop).to_have_text("STOP", timeout=PATIENCE_MS)
    stop.click()
    expect(stop).to_have_text("STOP NOT SENT", timeout=PATIENCE_MS)
    assert problems == []


def tell(feed: SimulationFeed, stopped: bool, *names: str) -> None:
    """Let robots say whether they are stopped."""
    with feed.lock:
        for name in names:
            feed.picture.put(name, "mesh/stopped", {"stopped": stopped}, feed.now())


@pytest.mark.parametrize(("confirmed", "said"), [((), "STOPPING 0/3"), (("r0",), "STOPPED 1/3")])
def test_a_stop_that_not_all_robots_have_confirmed_when_the_server_goes_is_sent_again(
    confirmed: tuple[str, ...], said: str, feed: SimulationFeed, port: int, page: tuple[Any, list[str]]
) -> None:
    shown, problems = page
    first = Server(feed, port)
    shown.goto(first.address)
    shown.locator("#stop").click(timeout=PATIENCE_MS)
    expect(shown.locator("#stop")).to_have_text("STOPPING 0/3", timeout=PATIENCE_MS)
    tell(feed, True, *confirmed)
    expect(shown.locator("#stop b")).to_have_text(said, timeout=PATIENCE_MS)
    first.close()
    expect(shown.locator("#stop")).to_have_text("STOP NOT CONFIRMED", timeout=PATIENCE_MS)
    late, given = len(confirmed), stops(feed)  # who has confirmed is not told again
    second = Server(feed, port)
    try:
        wait_until(lambda: all(now > before for now, before in zip(stops(feed)[late:], given[late:], strict=True)))
    finally:
        second.close()
    assert problems == []


def test_the_stop_button_counts_those_alone_that_are_known_to_be_stopped_and_names_the_others(
    feed: SimulationFeed, shown: Any
) -> None:
    stop = shown.locator("#stop")
    with feed.lock:
        for service in ("mesh", "balancer"):
            feed.picture.alive("r2", service, True, feed.now())
    expect(stop).to_have_accessible_name("STOP: stop all robots", timeout=PATIENCE_MS)
    stop.click()
    tell(feed, True, "r0", "r2")
    expect(stop.locator("b")).to_have_text("STOPPED 2/3", timeout=PATIENCE_MS)
    expect(stop.locator("small")).to_have_text("not r1")
    tell(feed, True, "r1")
    expect(stop).to_have_text("STOPPED 3/3", timeout=PATIENCE_MS)
    with feed.lock:
        feed.picture.alive("r2", "mesh", False, feed.now())  # its balancer is there, and nobody hears what holds
    expect(stop.locator("b")).to_have_text("STOPPED 2/3", timeout=PATIENCE_MS)
    expect(stop.locator("small")).to_have_text("not r2")
    expect(shown.locator("[data-answer=alive] small")).to_have_text("not confirmed by r2; take the stops back to go on")
    name = "STOPPED 2/3, not confirmed by r2 (gone): stop all robots"
    expect(stop).to_have_accessible_name(name)
    expect(shown.locator("#halt [role=status]")).to_have_text("STOPPED 2/3, not confirmed by r2 (gone)")
    with feed.lock:
        feed.picture.alive("r2", "mesh", True, feed.now())
    name = "STOPPED 2/3, not confirmed by r2: stop all robots"  # its mesh has not said yet what it knows
    expect(stop).to_have_accessible_name(name, timeout=PATIENCE_MS)
    tell(feed, True, "r2")
    expect(stop).to_have_text("STOPPED 3/3", timeout=PATIENCE_MS)


def test_a_stop_that_the_server_refuses_is_shown_as_not_sent_and_goes_out_when_a_robot_is_there_again(
    feed: SimulationFeed, shown: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = False
    monkeypatch.setattr("laptop.view.feeds.feed.is_live", lambda _: live)
    stop = shown.locator("#stop")
    expect(shown.locator("#connection")).to_have_text("the run has ended", timeout=PATIENCE_MS)
    stop.click()
    expect(shown.locator("#said")).to_have_text("the simulation has ended", timeout=PATIENCE_MS)
    expect(stop).to_have_text("STOP NOT SENT", timeout=PATIENCE_MS)
    assert stops(feed) == [0, 0, 0]
    live = True
    wait_until(lambda: min(stops(feed)) >= 1)
    expect(stop).to_have_text("STOPPING 0/3", timeout=PATIENCE_MS)


def test_a_page_sees_that_another_one_has_taken_its_stop_back_before_any_robot_had_confirmed_it(
    feed: SimulationFeed, shown: Any, browser: Any
) -> None:
    stop = shown.locator("#stop")
    stop.click(timeout=PATIENCE_MS)
    expect(stop).to_have_text("STOPPING 0/3", timeout=PATIENCE_MS)
    other = browser.new_page()
    try:
        other.goto(shown.url)
        until(other, "swarmView.store.newest")
        other.evaluate("swarmView.store.stops.set('r0', true)")
        other.locator("#arm").click(timeout=PATIENCE_MS)
    finally:
        other.close()
    expect(stop).to_have_text("STOP", timeout=PATIENCE_MS)
    expect(shown.locator("#said")).to_have_text("the stop was taken back elsewhere")


def test_a_page_without_a_server_waits_longer_from_try_to_try_and_says_so(
    feed: SimulationFeed, port: int, page: tuple[Any, list[str]]
) -> None:
    shown, problems = page
    tried: list[Any] = []
    shown.on("websocket", lambda each: tried.append(each))
    first = Server(feed, port)
    shown.goto(first.address)
    expect(shown.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)
    assert len(tried) == 1
    first.close()
    expect(shown.locator("#trying")).to_have_text(re.compile(r"tries again in [34] s"), timeout=PATIENCE_MS)
    assert len(tried) <= 8, "at once, and after 0.25, 0.5, 1 and 2 s"
    second = Server(feed, port)
    try:
        expect(shown.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)
        expect(shown.locator("#trying")).to_be_hidden()
    finally:
        second.close()
    assert problems == []


def test_a_page_on_a_slow_network_connects_and_has_not_lost_its_server(feed: SimulationFeed, page: Any) -> None:
    shown, _ = page
    shown.clock.install()
    shown.route_web_socket("**/live*", lambda _: None)  # nothing arrives
    serving = Server(feed, 0)
    try:
        shown.goto(serving.address)
        shown.clock.run_for(5000)
        expect(shown.locator("#connection")).to_have_text("connecting")
    finally:
        serving.close()


ODD = [5, None, "x", [], [5], [{}], {}, {"a": {}}, [[[]]], 1e16, 1e300, -1, True, "\x1b[31m<b>"]


def test_nothing_that_a_robot_says_breaks_the_page_or_hides_its_stop(feed: SimulationFeed, shown: Any) -> None:
    """r1 puts something odd into each field of each key in turn; r0 goes on to be shown."""
    row(shown, "r1").click(timeout=PATIENCE_MS)
    for number, (odd, shape) in enumerate(itertools.product(ODD, range(4))):
        with feed.lock:
            for (service, topic), kind in topics().items():
                key = f"swarm/r1/{service}/{topic}".replace("*", "x")
                fields = list(kind.__dataclass_fields__)  # type: ignore[attr-defined]
                shapes = ([odd], [dict.fromkeys(fields, odd)], [{"k": number, "t": odd}], [{f: odd} for f in fields])
                for message in shapes[shape]:  # the page is shown the last one
                    feed.picture.take("r1", key, msgpack.packb(message), float(number))
            feed.picture.put("r0", "app/x/state", {"t": float(number), "k": number, "state": {}}, float(number))
        until(shown, f"swarmView.store.get('r0', 'app/x/state')?.k === {number}")
        shown.wait_for_timeout(300)  # a round of all panels
    expect(row(shown, "r0")).to_contain_text("x", timeout=PATIENCE_MS)
    shown.locator("#stop").click()
    wait_until(lambda: min(stops(feed)) >= 1)


BIG, SMALL = 1.7e308, 5e-324
PAIRS = [
    (2.5833333333333335, 2.583333333333334),  # nothing is between them: what robots hold that have agreed
    (1e-300, 1e-300 + 1e-316),
    (1e16, 1e16 + 2),
    (0.0, SMALL),
    (SMALL, 1.0),
    (-BIG, BIG),
    (BIG, BIG),
    (0.9 * BIG, BIG),
]


def test_values_that_hardly_differ_or_are_of_any_size_have_a_chart_with_few_numbers_at_its_side(
    feed: SimulationFeed, shown: Any
) -> None:
    until(shown, "swarmView.store.swarm")
    for number, pair in enumerate(PAIRS):
        shown.evaluate(f"swarmView.values.open('app/x/state', ['state', 'v{number}'])")
        until(shown, f"swarmView.series.entries.get('app/x/state state.v{number}')?.sources[0].told")
        for robot, value in zip(("r0", "r1"), pair, strict=True):
            message = {"t": 0.0, "k": number, "state": {f"v{number}": value}}
            with feed.lock:
                feed.picture.put(robot, "app/x/state", message, float(number))
        for log in ("false", "true"):
            shown.evaluate(f"swarmView.values.chart.set('log', {log})")
            chart = "swarmView.values.chart.plot"
            until(shown, f"{chart}.log === {log} && {chart}.lines.length === 2")
            until(shown, f"{chart}.plot.axes[1]._splits?.length < 100")


EXTREME: list[tuple[str, dict[str, object]]] = [
    *(("dwm/pose", {"t": 1.0, "x": x, "y": x, "deviation_x": BIG, "deviation_y": SMALL}) for x in (1e16, BIG, SMALL)),
    *(("sim/truth", {"t": 1.0, "x": x, "y": -x, "heading": x, "tilt": x}) for x in (1e16, 1e300, BIG, SMALL)),
    *(("sim/target", {"t": 1.0, "x": x, "y": -x}) for x in (1e16, BIG)),
    *(("app/x/state", {"t": t, "k": 2**60 + k, "state": {"v": v}}) for k, t, v in ((0, 1.0, BIG), (256, BIG, -BIG))),
    *(("app/x/state", {"t": float(k), "k": 2**53 + k, "result": {"x": v, "y": v}}) for k, v in ((0, BIG), (2, SMALL))),
    ("app/x/progress", {"t": 1.0, "phase": "waiting", "k": 2**62, "waiting_for": ["r0"] * 100}),
    ("app/x/parameters", {"t": 1.0, "parameters": {"period": {"value": SMALL, "low": -BIG, "high": BIG}}}),
    ("app/x/state", {"t": 9.0, "k": 2**53 + 4, "state": {"v": 0.0}}),
    ("mesh/clock", {"t": 1.0, "offset": BIG, "error": BIG, "root": "r0"}),
]

MANY = 4000
NO_TEXT = {"toString": 1}
LONG: list[tuple[str, object]] = [
    ("mesh/topology", {"version": 2**53, "step": 0, "edges": [["r1", f"x{n}"] for n in range(3000)]}),
    ("mesh/links", {"links": [{}] * MANY}),
    ("app/x/progress", {"t": 1.0, "phase": "waiting", "waiting_for": [f"x{n}" for n in range(MANY)]}),
    *((f"app/b{n}/state", {"t": 1.0, "k": 0}) for n in range(150)),
    ("app/a0/state", {"t": 1.0, "k": 0}),
    *((f"app/a{n}/parameters", {"parameters": {"waypoints": {"value": ", " * 30_000}}}) for n in range(5)),
    *((f"app/a0/out/o{n}", {"t": 1.0, "values": {f"v{i}": i for i in range(MANY)}}) for n in range(5)),
    ("app/a1/state", {"t": 1.0, "k": 1, "state": {"v": [0] * MANY}}),
    ("app/a1/parameters", {"parameters": {f"p{n}": {"live": True, "value": n} for n in range(1000)}}),
    ("app/a2/parameters", {"parameters": {"p": {"live": True, "value": "", "choices": [""] * MANY}}}),
    *(("app/a0/record/zz", {"t": 1.0, "k": k, "values": {"value": 0.0}}) for k in (-(2**60), -(2**60) + 256)),
    ("a/b", 5),
    ("balancer/state", {"t": 1.0, "mode": "idle", "battery_level": "constructor"}),
    ("app/a0/progress", {"t": 1.0, "phase": "constructor"}),
    ("view/apps", {"apps": 5}),
    ("view/reach", {"by": None, "why": NO_TEXT}),
    ("a/c", {"t": NO_TEXT}),
    ("a/parameters_set", {"problem": NO_TEXT}),
    ("app/a0/out/state", {"t": 1.0, "result": {"x": 0, "y": 0, "var_x": 1, "var_y": 1, "cov_xy": NO_TEXT}}),
]


def test_no_number_or_list_that_a_robot_tells_holds_up_the_pages_stop(feed: SimulationFeed, shown: Any) -> None:
    """The page goes through what it shows: grid lines between places, lines between iterations, entries of lists."""
    row(shown, "r1").click(timeout=PATIENCE_MS)
    shown.evaluate("swarmView.values.chart.set('over', 'k')")
    for number, (key, message) in enumerate((*EXTREME, *LONG)):
        with feed.lock:
            feed.picture.take("r1", f"swarm/r1/{key}", msgpack.packb(message), float(number))
        assert feed.picture.newest("r1", key) is not None, (key, message)
        if key.startswith("app/b"):
            continue  # all of them at once
        shown.wait_for_timeout(600)  # a round of all panels
        given = min(stops(feed))
        shown.locator("#stop").click(timeout=PATIENCE_MS)
        wait_until(lambda given=given: min(stops(feed)) > given, what=f"a stop beside {key}")
    with feed.lock:
        feed.picture.put("r0", "app/x/state", {"t": 1.0, "k": 777, "state": {}}, 1000.0)
    expect(row(shown, "r0")).to_contain_text("777", timeout=PATIENCE_MS)
