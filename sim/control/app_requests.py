"""Requests to a running simulation: apps of its robots start and stop, as systemd would have it on real ones.

A request is a datagram to RUN/orders.sock, and the simulation answers by another one. Both are msgpack maps.
"""

import socket
from collections.abc import Sequence
from pathlib import Path

import msgpack

from swarm.app.settings import parse
from swarm.errors import LocalError, PayloadError
from swarm.frozen import frozen
from swarm.messages.codec import decode, encode
from swarm.messages.keys import is_name
from swarm.process.paths import socket_path

SOCKET = "orders.sock"
ACTS = ("start", "stop")
MAX_DATAGRAM = 65536
ANSWER_S = 20.0
"""Seconds that a simulation may take to answer; it looks for requests twenty times a second, and starts a process for
each robot."""


@frozen
class AppRequest:
    """A request to start, stop or change an app of the simulation."""

    act: str
    """One of `ACTS`."""
    app: str
    robots: tuple[str, ...]
    settings: tuple[str, ...] = ()
    """Settings for an app that has not run yet, as for `--set`: `NAME=VALUE`."""


def request_app(run_dir: Path, act: str, app: str, robots: Sequence[str], settings: Sequence[str] = ()) -> str:
    """Have the simulation in `run_dir` start or stop an app. Return what was done, in words. Raises `LocalError`."""
    order = encode(check(act, app, robots, settings))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind("")  # a name that the kernel chooses, for the answer
        sock.settimeout(ANSWER_S)
        try:
            sock.sendto(order, str(socket_path(run_dir, SOCKET)))
            answer = msgpack.unpackb(sock.recv(MAX_DATAGRAM))
        except TimeoutError:
            raise LocalError(f"the simulation has not answered within {ANSWER_S:g} s; look whether it did it") from None
        except OSError as error:
            raise LocalError(f"the simulation in {run_dir} takes no orders ({error.strerror})") from None
    if answer["problem"]:
        raise LocalError(answer["problem"])
    return str(answer["done"])


def check(act: str, app: str, robots: Sequence[str], settings: Sequence[str] = ()) -> AppRequest:
    """Return the request with these values. Raises `LocalError` for values that no request has."""
    if act not in ACTS:
        raise LocalError(f"expected {' or '.join(ACTS)}, got {act[:20]!r}")
    if not is_name(app):
        raise LocalError(f"{app[:20]!r} is no name of an app")
    if not robots or not all(map(is_name, robots)):
        raise LocalError("expected names of robots")
    for setting in settings:
        parse(setting)
    return AppRequest(act, app, tuple(robots), tuple(settings))


def unpack(datagram: bytes) -> AppRequest:
    """Return the request in a datagram. Raises `PayloadError` for a datagram without one."""
    try:
        found = decode(AppRequest, datagram, SOCKET)
        return check(found.act, found.app, found.robots, found.settings)
    except (PayloadError, LocalError) as error:
        raise PayloadError(f"no order: {error}") from None
