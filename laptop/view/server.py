"""The page and its WebSocket, on this machine only.

Who has the address has the page: it carries a token, made anew for each start. Pages of other origins are refused: a
browser would send the token along. Each page is told of what moves at most `RATE` times a second and of all else some
times, and only when it has taken the last ones. What a page asks never waits for what it is told (`questions`).
"""

import asyncio
import concurrent.futures
import contextlib
import hmac
import logging
import secrets
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from laptop.view import series
from laptop.view.actions.control import Control
from laptop.view.camera import add_camera
from laptop.view.feeds.feed import LiveFeed
from laptop.view.feeds.picture import TRAIL_S
from laptop.view.layouts import Layouts, default_path
from laptop.view.playing import Playing, number_asked
from laptop.view.questions import MAX_WAITING, Answer, Questions, as_json
from laptop.view.recording import ViewedRecording
from laptop.view.scene import fixed_parts
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json

HOST = "127.0.0.1"
RATE = 25.0
"""The most steps a second that a page gets. Places arrive at 10 Hz, and the page draws the movement between them."""

FULL = 5
"""One in so many steps has all keys, events and services: nobody reads numbers that change more often."""

CROWD = 50
"""The number of robots from which on a page gets full steps only."""

HEARTBEAT_S = 10.0
"""Seconds between two pings. The server closes the connection of a page that needs half of that to answer, and the page
connects again when it can."""

REPEAT_S = 0.2
"""Seconds between two checks whether robots have confirmed a stop."""

PAGE = Path(__file__).with_name("page")
_MAX_REQUEST = 4096
_POLICY = (
    "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; connect-src 'self' ws:; "
    "frame-ancestors 'none'"
)
"""The policy by which a page loads nothing from the network."""

EXPECTED = (
    "expected {series: {topic, fields}}, {do: {act, ...}}, {pace: {speed, paused}}, {look: {t}} or "
    "{layout: {name, panels}}"
)

Feed = LiveFeed | ViewedRecording

_FEED: web.AppKey[Feed] = web.AppKey("feed")
_TOKEN: web.AppKey[str] = web.AppKey("token")
_CONTROL: web.AppKey[Control | None] = web.AppKey("control")
_LAYOUTS: web.AppKey[Layouts] = web.AppKey("layouts")
_HALTS: web.AppKey[concurrent.futures.Executor] = web.AppKey("halts")
"""A thread that carries out stops, and nothing else."""
_BUILDERS: web.AppKey[concurrent.futures.Executor] = web.AppKey("builders")
BUILDERS = 4
"""Threads that build what pages are told."""

_log = logging.getLogger("view")


def application(feed: Feed, control: Control | None, token: str) -> web.Application:
    """Return the server, which `serve` runs. `control` is None where there is nothing to control, as in a recording."""
    app = web.Application(middlewares=[_guard])
    app[_FEED], app[_CONTROL], app[_TOKEN] = feed, control, token
    app[_LAYOUTS] = Layouts(default_path())
    app[_HALTS] = halts = concurrent.futures.ThreadPoolExecutor(1, "stops")
    app[_BUILDERS] = builders = concurrent.futures.ThreadPoolExecutor(BUILDERS, "steps")
    for pool in (halts, builders):
        app.on_cleanup.append(partial(_shut_down, pool))
    app.router.add_get("/", _index)
    app.router.add_get("/live", _live)
    app.router.add_static("/page", PAGE)
    add_camera(app, feed if isinstance(feed, ViewedRecording) else None)
    return app


async def _shut_down(pool: concurrent.futures.Executor, _: web.Application) -> None:
    await asyncio.to_thread(pool.shutdown, cancel_futures=True)


@web.middleware
async def _guard(request: web.Request, handler: Callable[..., Any]) -> web.StreamResponse:
    """Serve only a browser on this machine that has the token; the page's own parts hold no secrets."""
    origin, host = request.headers.get("Origin"), request.headers.get("Host", "")
    if host.partition(":")[0] not in (HOST, "localhost") or origin not in (None, f"http://{host}"):
        raise web.HTTPForbidden(text="this page is for the machine that it was started on\n")
    if not request.path.startswith("/page/"):
        given = request.query.get("token", "")
        if not hmac.compare_digest(given.encode(), request.app[_TOKEN].encode()):
            raise web.HTTPForbidden(text="open the address that `swarm view` has printed: the token in it is missing\n")
    response: web.StreamResponse = await handler(request)
    if not response.prepared:
        response.headers["Cache-Control"] = "no-store"
        response.headers["Content-Security-Policy"] = _POLICY
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["X-Content-Type-Options"] = "nosniff"
    return response


async def _index(_: web.Request) -> web.StreamResponse:
    return web.FileResponse(PAGE / "index.html")


async def _live(request: web.Request) -> web.StreamResponse:
    # Nothing is compressed: the page is on this machine, and one that has gone away would leave a task behind.
    socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, max_msg_size=_MAX_REQUEST, compress=False)
    await socket.prepare(request)
    feed, control, layouts = request.app[_FEED], request.app[_CONTROL], request.app[_LAYOUTS]
    if isinstance(feed, ViewedRecording):
        await _play(Playing(feed, request.app[_LAYOUTS], request.query.get("run")), socket)
        return socket
    loop, halts = asyncio.get_running_loop(), request.app[_HALTS]
    questions = Questions(
        # Threads do the work: a simulation takes its time to obey, and the page's pictures go on.
        lambda asked: loop.run_in_executor(halts, _halted, feed, control, layouts, asked),
        lambda asked: asyncio.to_thread(_told, feed, control, layouts, asked),
        socket.send_str,
    )
    told = _tell(_PageSteps(feed, control, layouts), socket, request.app[_BUILDERS])
    tasks = [asyncio.create_task(told), asyncio.create_task(questions.run())]
    try:
        async for asked, problem in _messages(socket):
            if problem:
                questions.tell(as_json({"refused": problem}))
            else:
                await questions.take(asked)
    finally:
        for task in tasks:
            task.cancel()
        for ended in await asyncio.gather(*tasks, return_exceptions=True):
            _tell_defect(ended)
    return socket


async def _messages(socket: web.WebSocketResponse) -> AsyncIterator[tuple[Any, str]]:
    """Yield what a page asks, and what is wrong with it, empty where nothing is."""
    async for message in socket:
        if message.type == WSMsgType.TEXT:
            try:
                asked, problem = read_json(message.data), ""
            except PayloadError as error:
                asked, problem = None, str(error)
            yield asked, problem


def _tell_defect(ended: object) -> None:
    """Log why a page's task has ended, unless the page is gone."""
    if isinstance(ended, BaseExceptionGroup):
        for each in ended.exceptions:
            _tell_defect(each)
    elif isinstance(ended, Exception) and not isinstance(ended, ConnectionError):
        _log.error("a page is told no more", exc_info=ended)


class _PageSteps:
    """What one page has been told of a feed, and what it is to be told next."""

    def __init__(self, feed: LiveFeed, control: Control | None, layouts: Layouts) -> None:
        self._feed, self._control, self._layouts = feed, control, layouts
        self._known: dict[str, Any] = {}
        self._moved: dict[str, int] = {}
        self._rest: dict[str, int] = {}
        """Versions of the picture by robot: the page has been told of what moves, and of all else, up to there."""
        self._number = self._count = 0

    @property
    def crowd(self) -> bool:
        """Return whether the swarm is so large that the page is told seldom."""
        return self._feed.config is not None and len(self._feed.config.names) >= CROWD

    def next(self) -> str:
        """Return all that is there at first, and later what has changed, as JSON. This takes long where robots say
        much."""
        feed = self._feed
        now = feed.now()
        step: dict[str, Any] = {"t": now, "live": feed.live}
        parts: dict[str, Any] = {}
        full = self.crowd or self._count % FULL == 0
        self._count += 1
        with feed.lock:
            picture = feed.picture
            names = picture.robots
            parts["hops"] = picture.hops()
            if full:
                if events := picture.events_since(self._number):
                    step["events"] = [event._asdict() for event in events]
                    self._number = events[-1].number
                parts["services"] = {robot: dict(each) for robot, each in picture.services().items()}
        robots, trails = {}, {}
        for name in names:
            with feed.lock:
                samples = picture.since(name, self._moved.get(name, 0), self._rest.get(name, 0) if full else None)
                trail = picture.trail(name, TRAIL_S, now) if full and name not in self._rest else None
                self._moved[name] = picture.version
                if full:
                    self._rest[name] = picture.version
            if new := picture.values(name, samples, feed.lock):
                robots[name] = new
            if trail is not None:
                trails[name] = list(trail)
        if robots:
            step["robots"] = robots
        if trails:
            step["trails"] = trails
        if full:
            parts |= {"swarm": fixed_parts(feed, self._control), "pace": feed.pace(), "layouts": self._layouts.told()}
            parts["halt"] = None if self._control is None else self._control.halt
        for name, value in parts.items():
            if self._known.get(name) != value:
                step[name] = self._known[name] = value
        return as_json(step)


async def _tell(steps: _PageSteps, socket: web.WebSocketResponse, builders: concurrent.futures.Executor) -> None:
    """Tell a page what there is, then what changes. A step is built in a thread: a stop that a page asks for must not
    wait until all that a robot has said is taken apart."""
    loop = asyncio.get_running_loop()
    while not socket.closed:
        await socket.send_str(await loop.run_in_executor(builders, steps.next))
        await asyncio.sleep((FULL if steps.crowd else 1) / RATE)


async def _play(playing: Playing, socket: web.WebSocketResponse) -> None:
    """Answer a page that goes through a recording at its own pace. Numbers over the whole run take long: they have a
    queue of their own, so that the page plays on meanwhile."""

    async def answer(asked: Any) -> None:
        found = await asyncio.to_thread(playing.answer, asked)
        await socket.send_str(await asyncio.to_thread(as_json, found))

    async def answer_series() -> None:
        while True:
            await answer(await charts.get())

    charts = asyncio.Queue[Any](MAX_WAITING)
    try:
        async with asyncio.TaskGroup() as group:
            await socket.send_str(as_json(playing.first()))
            drawing = group.create_task(answer_series())
            async for asked, problem in _messages(socket):
                if problem:
                    await socket.send_str(as_json({"refused": problem}))
                elif isinstance(asked, dict) and "series" in asked:
                    await charts.put(asked)
                else:
                    await answer(asked)
            drawing.cancel()
    except* ConnectionError:
        pass  # the page is gone before its answer is there


def _told(feed: LiveFeed, control: Control | None, layouts: Layouts, asked: Any) -> str:
    """Return the answer to what a page asks, as JSON."""
    return as_json(_answer(feed, control, layouts, asked))


def _halted(feed: LiveFeed, control: Control | None, layouts: Layouts, asked: Any) -> str:
    """Return the answer to a stop or its end, as JSON. It says what it answers: a page shows where a stop was
    refused."""
    answer = _answer(feed, control, layouts, asked)
    return as_json(answer | {"act": asked["do"]["act"], "halt": None if control is None else control.halt})


def _answer(feed: LiveFeed, control: Control | None, layouts: Layouts, asked: Any) -> Answer:
    """Return the answer to what a page asks: numbers of a key over time, a past instant, a layout, or an act."""
    try:
        if "do" in asked:
            if control is None:
                return {"refused": "a virtual run is only watched"}
            return {"done": control.do(asked["do"])}
        if "pace" in asked:
            speed = asked["pace"]["speed"]
            feed.set_pace(None if speed is None else number_asked(speed), bool(asked["pace"]["paused"]))
            return {"done": "paused" if asked["pace"]["paused"] else f"speed: {speed or 'max'}"}
        if "layout" in asked:
            return {"done": layouts.keep(asked["layout"]), "layouts": layouts.told()}
        if "look" in asked:
            return _look(feed, number_asked(asked["look"]["t"]))
        topic, fields = series.wanted(asked["series"])
    except LocalError as error:
        return {"refused": str(error)}
    except (ValueError, KeyError, TypeError, OverflowError):
        return {"refused": EXPECTED}
    except Exception:  # noqa: BLE001 - a defect of ours, and the page's way to a stop lives on
        _log.exception("an act has failed")
        return {"refused": "this program has a defect there: its log says more"}
    found: dict[str, list[series.Row]] = {}
    with feed.lock:
        robots = feed.picture.robots
    for robot in robots:
        with feed.lock:
            samples = feed.picture.history(robot, topic, series.most_of(len(robots)))
        if rows := series.rows(samples, fields):
            found[robot] = rows
    return {"series": {"topic": topic, "fields": fields, "rows": found}}


def _look(feed: LiveFeed, t: float) -> Answer:
    """Return what a page showed at an instant of the last two minutes."""
    robots, trails = {}, {}
    with feed.lock:
        picture = feed.picture
        names = picture.robots
        events = [event._asdict() for event in picture.events_since(0) if event.t <= t]
    for name in names:
        with feed.lock:
            samples, trail = picture.look(name, t), picture.trail(name, TRAIL_S, t)
        if then := picture.values(name, samples, feed.lock):
            robots[name], trails[name] = then, list(trail)
    return {"look": {"t": t, "live": True, "robots": robots, "trails": trails, "events": events}}


async def _repeat(control: Control, thread: concurrent.futures.Executor) -> None:
    """Repeat what robots have not confirmed. `thread` does nothing else: acts that hang do not delay the repetition of
    a stop, and a new stop does not wait for the picture, at which `control.repeat` looks."""
    while True:
        await asyncio.sleep(REPEAT_S)
        try:
            await asyncio.get_running_loop().run_in_executor(thread, control.repeat)
        except Exception:  # noqa: BLE001 - whatever it is, the next stop has to be repeated, too
            _log.exception("what robots have not confirmed could not be repeated")


def end_on_signals(ended: asyncio.Event) -> None:
    """Set `ended` at Ctrl-C and SIGTERM. Windows' event loop takes no handlers: there Ctrl-C is a KeyboardInterrupt."""
    with contextlib.suppress(NotImplementedError):
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)


async def serve(
    feed: Feed, control: Control | None, port: int, ready: Callable[[str], Awaitable[None]], ended: asyncio.Event
) -> None:
    """Serve until `ended`. `ready(address)` is awaited when the page can be opened. Raises `LocalError` where the port
    is taken."""
    token = secrets.token_urlsafe(16)
    runner = web.AppRunner(application(feed, control, token), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        site = web.TCPSite(runner, HOST, port)
        try:
            await site.start()
        except OSError as error:
            raise LocalError(f"port {port} of {HOST}: {error.strerror}; --port names another one, 0 any") from None
        _, taken, *_ = runner.addresses[0]
        with concurrent.futures.ThreadPoolExecutor(1, "repeats") as thread:
            repeating = None if control is None else asyncio.create_task(_repeat(control, thread))
            try:
                await ready(f"http://{HOST}:{taken}/?token={token}")
                await ended.wait()
            finally:
                if repeating is not None:
                    repeating.cancel()
    finally:
        await runner.cleanup()
