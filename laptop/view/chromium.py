"""The Chromium or Chrome of this machine, without a window: one page, told what to do by the DevTools protocol.

Through pipes, so that nobody else on this machine can reach it: the browser reads messages from descriptor 3 and writes
them to 4, each a JSON object with a zero byte behind it.
"""

import asyncio
import base64
import contextlib
import fcntl
import json
import os
import shutil
import signal
import tempfile
from collections.abc import AsyncIterator
from typing import Any

from swarm.errors import LocalError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE_S = 60.0
"""Seconds to wait for the start and for each answer: machines may be slow, and a large picture takes long."""
POLL_S = 0.05
_LONGEST = 1 << 27
"""The most bytes of a message: a picture of 4096 x 2160 pixels in base64."""


def browser() -> str:
    """Return the browser to use. Raises `LocalError` where there is none."""
    for name in BROWSERS:
        if (path := shutil.which(name)) is not None:
            return path
    raise LocalError(f"no {', '.join(BROWSERS)} found: apt-get install chromium")


class Page:
    """A page of a browser of its own; made by `opened`."""

    def __init__(self, pid: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.pid = pid
        """Process id of the browser and of its process group."""
        self._reader, self._writer = reader, writer
        self._number = 0
        self._session: str | None = None

    async def start(self, size: tuple[int, int], scale: float, address: str) -> None:
        """Show what is at `address`."""
        target = (await self._ask("Target.createTarget", url="about:blank"))["targetId"]
        self._session = (await self._ask("Target.attachToTarget", targetId=target, flatten=True))["sessionId"]
        width, height = size
        await self._ask(
            "Emulation.setDeviceMetricsOverride",
            width=round(width / scale),
            height=round(height / scale),
            deviceScaleFactor=scale,
            mobile=False,
        )
        await self._ask("Page.navigate", url=address)

    async def evaluate(self, expression: str) -> Any:
        """Return the value of an expression of JavaScript; of a promise the value that it promises. Raises
        `LocalError` where the expression fails."""
        found = await self._ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if (problem := found.get("exceptionDetails")) is not None:
            said = problem.get("exception", {}).get("description", problem.get("text"))
            raise LocalError(f"the page: {said}")
        return found["result"].get("value")

    async def until(self, condition: str) -> None:
        """Wait until an expression is true. Raises `LocalError` where that takes too long."""
        deadline = asyncio.get_running_loop().time() + PATIENCE_S
        while not await self.evaluate(condition):
            if asyncio.get_running_loop().time() > deadline:
                raise LocalError(f"the page has shown nothing within {PATIENCE_S:g} s")
            await asyncio.sleep(POLL_S)

    async def picture(self) -> bytes:
        """Return the visible page as a PNG."""
        found = await self._ask("Page.captureScreenshot", format="png", optimizeForSpeed=True)
        return base64.b64decode(found["data"])

    async def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        try:
            self._writer.write(json.dumps(message).encode() + b"\0")
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    answer = json.loads((await self._reader.readuntil(b"\0"))[:-1])
                    if answer.get("id") == self._number:
                        break
        except TimeoutError:
            raise LocalError(f"the browser has not answered within {PATIENCE_S:g} s ({method})") from None
        except (asyncio.IncompleteReadError, ConnectionError):
            raise LocalError("the browser has ended") from None
        if "error" in answer:
            raise LocalError(f"the browser: {method}: {answer['error'].get('message')}")
        result: dict[str, Any] = answer["result"]
        return result


@contextlib.asynccontextmanager
async def opened(address: str, size: tuple[int, int], scale: float = 1.0) -> AsyncIterator[Page]:
    """Yield a page of `size` pixels that shows `address`; the browser ends with it. A `scale` below 1 makes all of
    it smaller. Raises `LocalError`."""
    program = browser()
    with tempfile.TemporaryDirectory(prefix="swarm-view-", ignore_cleanup_errors=True) as profile:
        options = [
            "--headless=new",
            "--remote-debugging-pipe",
            f"--user-data-dir={profile}",
            f"--window-size={size[0]},{size[1]}",
            "--hide-scrollbars",
            "--mute-audio",
            "--no-first-run",
            *(
                ["--no-sandbox"] if os.geteuid() == 0 else []
            ),  # a browser of root does not start otherwise; it sees our page only
        ]
        pid, our_in, our_out = _spawn([program, *options])
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=_LONGEST)
        reading, _ = await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(our_in, "rb"))
        writing, protocol = await loop.connect_write_pipe(asyncio.streams.FlowControlMixin, os.fdopen(our_out, "wb"))
        try:
            page = Page(pid, reader, asyncio.StreamWriter(writing, protocol, reader, loop))
            await page.start(size, scale, address)
            yield page
        finally:
            reading.close()
            writing.close()
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)  # the browser has children, and nothing to keep
            await asyncio.to_thread(os.waitpid, pid, 0)


def _spawn(command: list[str]) -> tuple[int, int, int]:
    """Start a browser in a process group of its own. Return its pid, and the descriptors from which and to which we
    read and write."""
    (its_in, our_out), (our_in, its_out) = os.pipe(), os.pipe()
    high = [fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 10) for descriptor in (its_in, its_out)]  # neither is 3 or 4
    os.close(its_in)
    os.close(its_out)
    actions: list[Any] = [(os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_RDWR, 0) for number in (0, 1, 2)]
    actions += [(os.POSIX_SPAWN_DUP2, descriptor, number) for descriptor, number in zip(high, (3, 4), strict=True)]
    try:
        pid = os.posix_spawn(command[0], command, os.environ, file_actions=actions, setpgroup=0)
    except OSError as error:
        raise LocalError(f"{command[0]}: {error.strerror}") from None
    finally:
        for descriptor in high:
            os.close(descriptor)
    return pid, our_in, our_out
