"""Calls of one Bluetooth adapter: pages one at a time, set-ups beside them, the time of each from its page on."""

import errno
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest
from conftest import wait_until

from services.mesh.links.page import Paging


class CallingSocket(socket.socket):
    """A socket whose connection is made when a test says so: until then it cannot be written."""

    def __init__(self, begun: list[str]) -> None:
        ours, self.other = socket.socketpair()
        super().__init__(fileno=ours.detach())
        self.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                super().send(bytes(65536))
        self.begun = begun
        self.error = 0

    def connect(self, address: tuple[str, int]) -> None:  # type: ignore[override]
        self.begun.append(address[0])
        raise BlockingIOError(errno.EINPROGRESS, "under way")

    def getsockopt(self, *_: int) -> int:  # type: ignore[override]
        return self.error

    def end(self, error: int = 0) -> None:
        self.error = error
        while not select.select([], [self], [], 0.0)[1]:
            self.other.recv(1 << 20)


class Calls:
    """Threads that call; `links` are those that an adapter has."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.links: set[str] = set()
        self.results: dict[str, str] = {}
        self.sockets: dict[str, CallingSocket] = {}
        self.threads: list[threading.Thread] = []
        self.paging = Paging("own", open_adapter=lambda own: self)  # type: ignore[arg-type,return-value]

    def is_connected(self, peer: str) -> bool:
        return peer in self.links

    def close(self) -> None:
        """Of the adapter that this is, too."""

    def call(self, peer: str, timeout: float = 60.0) -> None:
        self.sockets[peer] = sock = CallingSocket(self.begun)

        def run() -> None:
            try:
                self.paging.connect(sock, (peer, 1), timeout)
                self.results[peer] = "up"
            except OSError as error:
                self.results[peer] = errno.errorcode.get(error.errno or 0, "late")

        self.threads.append(threading.Thread(target=run))
        self.threads[-1].start()

    def end(self) -> None:
        for thread in self.threads:
            thread.join()
        for sock in self.sockets.values():
            sock.close()
            sock.other.close()


@pytest.fixture
def calls() -> Iterator[Calls]:
    made = Calls()
    yield made
    made.end()


def test_the_next_call_pages_when_a_page_was_answered_or_has_failed(calls: Calls) -> None:
    calls.call("a")
    wait_until(lambda: calls.begun == ["a"])
    calls.call("b")
    assert calls.begun == ["a"]
    calls.links.add("a")
    wait_until(lambda: calls.begun == ["a", "b"])
    assert calls.results == {}  # both go on
    calls.call("c")
    calls.sockets["b"].end(errno.EHOSTDOWN)
    wait_until(lambda: calls.begun == ["a", "b", "c"])
    wait_until(lambda: calls.results == {"b": "EHOSTDOWN"})
    for peer in ("a", "c"):
        calls.sockets[peer].end()
    wait_until(lambda: calls.results == {"a": "up", "b": "EHOSTDOWN", "c": "up"})


def test_a_call_has_its_time_from_its_own_page_on(calls: Calls) -> None:
    calls.call("a")
    wait_until(lambda: calls.begun == ["a"])
    calls.call("b", timeout=0.0)
    assert calls.results == {}, "b waits, however long"
    calls.sockets["a"].end()
    wait_until(lambda: calls.results == {"a": "up", "b": "late"})
