"""A radio between robots that link over TCP: a process of its own, which hands on bytes as they came, but later.

On a robot the kernel and the Bluetooth controller do this. `sim:` links do it within the robots' own meshes.
"""

import argparse
import asyncio
import contextlib
import selectors
from functools import partial
from typing import cast

from swarm.process.edges import die_with_parent

LATENCY_S = 0.03


def in_range(robot: int) -> str:
    """The address at which others call a robot, by its number."""
    return f"127.0.2.{robot + 1}"


def of_robot(robot: int) -> str:
    """The address at which that robot listens."""
    return f"127.0.1.{robot + 1}"


class _End(asyncio.Protocol):
    """One end of a link; `other` is there before bytes come."""

    transport: asyncio.Transport
    other: "_End"

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        asyncio.get_running_loop().call_later(LATENCY_S, self.other.transport.write, data)

    def connection_lost(self, error: Exception | None) -> None:
        if hasattr(self, "other"):
            asyncio.get_running_loop().call_later(LATENCY_S, self.other.transport.close)


class _Caller(_End):
    """The end of the robot that called; what it says before the other end is there is kept for it."""

    def __init__(self, robot: int, port: int) -> None:
        self._address = of_robot(robot), port
        self._said = b""
        self._joining: asyncio.Task[None]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._joining = asyncio.get_running_loop().create_task(self._join())

    # Not by pause_reading: before Python 3.11.4 a transport reads all the same when it is asked for that here.
    def data_received(self, data: bytes) -> None:
        if hasattr(self, "other"):
            super().data_received(data)
        else:
            self._said += data

    async def _join(self) -> None:
        try:
            _, called = await asyncio.get_running_loop().create_connection(_End, *self._address)
        except OSError:
            self.transport.close()
            return
        self.other, called.other = called, self
        if self._said:
            super().data_received(self._said)


async def _serve(robots: int, port: int) -> None:
    loop = asyncio.get_running_loop()
    async with contextlib.AsyncExitStack() as stack:
        for robot in range(robots):
            server = await loop.create_server(partial(_Caller, robot, port), in_range(robot), port)
            await stack.enter_async_context(server)
        await asyncio.Event().wait()


def main() -> None:
    """`python -m bench.rigs.tcp_radio ROBOTS PORT`: until killed."""
    parser = argparse.ArgumentParser(prog="bench.rigs.tcp_radio", description=__doc__)
    parser.add_argument("robots", type=int)
    parser.add_argument("port", type=int)
    options = parser.parse_args()
    die_with_parent()
    # epoll waits whole milliseconds, select does not.
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(selectors.SelectSelector())) as runner:
        runner.run(_serve(options.robots, options.port))


if __name__ == "__main__":
    main()
