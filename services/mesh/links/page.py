"""Calls over Bluetooth that page one after the other.

A controller pages one robot at a time. The kernel has further calls wait, and an older one gives them up at their third
refusal. A page of an absent robot takes 5 s, so calls behind a few of those would run into their time-outs before they
have begun. So a call waits here, and its time begins with its page. While its link is being set up the next call pages.
"""

import contextlib
import os
import select
import socket
import threading
from collections.abc import Callable

from swarm import clock
from swarm.bluetooth.adapter import Adapter
from swarm.errors import LocalError

LOOK = 0.05
"""Seconds between two looks whether a page was answered."""


class Paging:
    """The pages of one adapter. Any thread may call."""

    def __init__(self, own: str, *, open_adapter: Callable[[str], Adapter] = Adapter) -> None:
        """`own`: Bluetooth address of the adapter. Where it cannot be asked, a call's page ends with the call."""
        self._own = own
        self._open = open_adapter
        self._lock = threading.Lock()

    def connect(self, sock: socket.socket, address: tuple[str, int], timeout: float) -> None:
        """Connect a socket; raises OSError, `TimeoutError` where that takes more than `timeout` s from its page on."""
        with self._lock:
            end = clock.now() + timeout
            sock.setblocking(False)
            try:
                sock.connect(address)
            except BlockingIOError:
                self._page(sock, address[0], end)
            else:
                return
        while not _is_over(sock, end - clock.now()):
            _check(end)
        if number := sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(number, os.strerror(number))

    def _page(self, sock: socket.socket, peer: str, end: float) -> None:
        """Wait until the page was answered, or the whole call is over."""
        with contextlib.ExitStack() as stack:
            adapter = None
            with contextlib.suppress(LocalError, OSError):
                adapter = stack.enter_context(contextlib.closing(self._open(self._own)))
            while not _is_over(sock, min(LOOK, end - clock.now())):
                _check(end)
                if adapter is not None and adapter.is_connected(peer):
                    return


def _is_over(sock: socket.socket, seconds: float) -> bool:
    """Return whether a call has come to its end, well or not; waits for it."""
    return bool(select.select([], [sock], [], max(0.0, seconds))[1])


def _check(end: float) -> None:
    if clock.now() >= end:
        raise TimeoutError
