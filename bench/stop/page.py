"""The page of `swarm view --control` as a program of its own has it, and a browser's end of its WebSocket."""

import asyncio
import contextlib
import json
import threading
from concurrent.futures import Future

import aiohttp

from laptop.view.actions.control import Control
from laptop.view.server import Feed, serve
from swarm.errors import LocalError

PATIENCE_S = 30.0
"""s within which the page is there, and within which it takes a stop."""


class Page:
    """Serves the page in a thread, and presses its stop button. A context."""

    def __init__(self, feed: Feed, control: Control) -> None:
        self._feed, self._control = feed, control
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._answers: asyncio.Queue[dict[str, object]] = asyncio.Queue()
        self._opened: Future[aiohttp.ClientWebSocketResponse] = Future()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def __enter__(self) -> "Page":
        self._thread.start()
        self._socket = self._opened.result(PATIENCE_S)
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(RuntimeError):  # its thread has failed, and has told why
            self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(PATIENCE_S)

    def stop(self) -> None:
        """Press the stop button; the stop was given when this returns."""
        asyncio.run_coroutine_threadsafe(self._stop(), self._loop).result(PATIENCE_S)

    async def _stop(self) -> None:
        await self._socket.send_json({"do": {"act": "stop"}})
        if "done" not in (answer := await self._answers.get()):
            raise LocalError(f"bench stop: the page's stop button: {answer}")

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._main())
        except BaseException as error:
            if self._opened.done():
                raise
            self._opened.set_exception(error)
        finally:
            self._loop.close()

    async def _main(self) -> None:
        async with contextlib.AsyncExitStack() as stack:

            async def opened(address: str) -> None:
                session = await stack.enter_async_context(aiohttp.ClientSession())
                socket = await stack.enter_async_context(session.ws_connect(address.replace("/?", "/live?")))
                reading = asyncio.create_task(self._read(socket))
                stack.callback(reading.cancel)
                self._opened.set_result(socket)

            await serve(self._feed, self._control, 0, opened, self._ended)

    async def _read(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        """Read what a browser would show, and keep what the page answers."""
        async for message in socket:
            step = json.loads(message.data)
            if step.keys() & {"done", "refused"}:
                self._answers.put_nowait(step)
