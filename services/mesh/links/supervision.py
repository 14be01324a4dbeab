"""The time for which the radio keeps a silent connection.

Its own time-out is 20 s, and a controller keeps what it could not deliver until then, in the few buffers that all its
connections share (8 on the robots'). A robot that goes off thus takes the buffers of each of its neighbours, which fall
silent towards all others (tests/lab/inside/inside_faults.py shows it with Linux's own Bluetooth). So whoever has called
sets a time-out below that of the mesh. It is the central's to do: the other side's controller would refuse.

The caller is to be the central (`services.mesh.core.routing.physical_links`), and is, unless the robot that it calls
has just knocked: the kernel then uses the connection of the knock, whose central is the robot that knocked. So the
caller looks, and asks for a switch of roles where it is not. A new hub does the same with links that it was called
on.
"""

import contextlib
import logging
import threading

from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter, check
from swarm.errors import LocalError

_log = logging.getLogger("mesh")
_told: set[str] = set()
_lock = threading.Lock()


def limit(adapter: Adapter, peer: str, seconds: float) -> None:
    """Let the connection to the Bluetooth address `peer` be over after so much silence. Raises `LocalError` where there
    is no such connection or an adapter refuses, and OSError."""
    if not adapter.is_central(peer):
        adapter.be_central(peer)
    check(adapter.ask(hci.write_supervision(adapter.handle(peer), seconds), hci.written_supervision))


def try_limit(own: str, peer: str, dead: float) -> None:
    """Limit the silence of a link for a mesh that takes a robot for dead after `dead` seconds. Links work without the
    limit, too: where it cannot be set, the reason is logged, once."""
    try:
        with contextlib.closing(Adapter(own)) as adapter:
            limit(adapter, peer, hci.SUPERVISION_SHARE * dead)
    except (LocalError, OSError) as error:
        text = str(error) if isinstance(error, LocalError) else hci.explained(error)
        with _lock:
            if text in _told:
                return
            _told.add(text)
        _log.warning("a robot that goes off may keep its neighbours' links waiting for 20 s: %s", text)
