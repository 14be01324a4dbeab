"""The additions of PyBluez where it is installed: robots in radio range, and service records that say who has a mesh.

The links themselves need none of it (`rfcomm`). On Debian it is the package python3-bluez, seen from a venv made with
--system-site-packages; service records also need bluetoothd run with -C. PyBluez has one exception, an OSError that may
carry a text in place of a number.
"""

import importlib
import os
from typing import Any

from swarm.errors import LocalError
from swarm.frozen import frozen

SERVICE = "8d0f1f8e-6c1b-4a86-9a57-0b5d9f0e7a31"
"""UUID of the mesh's service record, drawn once for this project."""

SERVICE_NAME = "balboa-swarm mesh"

INQUIRY_UNIT = 1.28
"""s; the length of an inquiry is counted in these (Core specification, vol 4 E, 7.1.1)."""


@frozen
class Found:
    """A Bluetooth device in range."""

    address: str
    name: str
    channel: int | None
    """RFCOMM channel of its mesh; None where it offers none, or was not asked."""


def load() -> Any:
    """Return the module `bluetooth`; `LocalError` that says how to get it."""
    try:
        return importlib.import_module("bluetooth")
    except ImportError:
        raise LocalError(
            "PyBluez is not installed: apt install python3-bluez, and make the venv with "
            "/usr/bin/python3 -m venv --system-site-packages (pip cannot build it for Python 3.11 and later)"
        ) from None


def discover(seconds: float, *, ask_services: bool, adapter: str = "") -> list[Found]:
    """Devices that answer an inquiry, sorted by address; raises OSError where the adapter cannot.

    `adapter`: hci1, or its address; the kernel's choice without. `LocalError` where there is none of that name.
    """
    bluetooth = load()
    units = max(1, round(seconds / INQUIRY_UNIT))
    chosen = {}
    if adapter:
        number = importlib.import_module("bluetooth._bluetooth").hci_devid(adapter)
        if number < 0:
            raise LocalError(f"there is no Bluetooth adapter {adapter}, or it is switched off: bluetoothctl list")
        chosen = {"device_id": number}
    pairs = bluetooth.discover_devices(duration=units, flush_cache=True, lookup_names=True, **chosen)
    return sorted(
        (
            Found(str(address).upper(), str(name), find_channel(str(address)) if ask_services else None)
            for address, name in pairs
        ),
        key=lambda found: found.address,
    )


def find_channel(address: str) -> int | None:
    """Return the RFCOMM channel of the mesh that a device offers; None where it offers none."""
    for record in load().find_service(uuid=SERVICE, address=address):
        if record.get("protocol") == "RFCOMM" and isinstance(record.get("port"), int):
            port: int = record["port"]
            return port
    return None


class Record:
    """The service record of a listening RFCOMM socket; it is there until closed. Raises OSError."""

    def __init__(self, descriptor: int) -> None:
        bluetooth = load()
        # PyBluez advertises only sockets of its own class on which its own listen was called, and takes no descriptor:
        # one of its own listens for a moment, on whichever channel is free, and is given ours then.
        self._sock = bluetooth.BluetoothSocket(bluetooth.RFCOMM)
        try:
            self._sock.bind(("", 0))
            self._sock.listen(1)
            os.dup2(descriptor, self._sock.fileno(), inheritable=False)
            bluetooth.advertise_service(
                self._sock,
                SERVICE_NAME,
                service_id=SERVICE,
                service_classes=[SERVICE, bluetooth.SERIAL_PORT_CLASS],
                profiles=[bluetooth.SERIAL_PORT_PROFILE],
            )
        except OSError:
            self._sock.close()
            raise

    def close(self) -> None:
        self._sock.close()
