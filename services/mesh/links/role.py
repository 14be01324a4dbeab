"""The Bluetooth role of this robot on each of its connections, central or peripheral, as the kernel has it. Asking
needs no rights; where it is impossible, roles are unknown."""

import contextlib
from collections.abc import Callable, Mapping

from services.mesh.core.routing.physical_links import CENTRAL, PERIPHERAL
from swarm.bluetooth.adapter import Adapter
from swarm.errors import LocalError

OpenAdapter = Callable[[str], Adapter]


class Roles:
    """The Bluetooth roles of one robot. Any thread may ask for the result of the last `look`."""

    def __init__(self, own: str, addresses: Mapping[str, str], *, open_adapter: OpenAdapter = Adapter) -> None:
        """`own`: Bluetooth address of the adapter; `addresses`: those of other robots, by name."""
        self._own = own
        self._addresses = addresses
        self._open = open_adapter
        self._found: Mapping[str, str] = {}

    def look(self) -> None:
        """Ask the kernel anew."""
        found = {}
        if self._addresses:
            with contextlib.suppress(LocalError, OSError), contextlib.closing(self._open(self._own)) as adapter:
                for name, address in self._addresses.items():
                    with contextlib.suppress(LocalError):  # no connection
                        found[name] = CENTRAL if adapter.is_central(address) else PERIPHERAL
        self._found = found

    def of(self, robot: str) -> str:
        """`CENTRAL` or `PERIPHERAL` in the connection to that robot; empty where it is not known."""
        return self._found.get(robot, "")
