"""bluetoothd over D-Bus: adapters, devices, and an agent that says yes to one device and no to all others.

BlueZ's interfaces org.bluez.Adapter1, Device1, AgentManager1 and Agent1 (org.bluez.*(5)). One thread: while an answer
is waited for, bluetoothd's questions to the agent are answered. jeepney speaks D-Bus; the laptop sends it along.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from typing import Any

from jeepney import (
    DBusAddress,
    HeaderFields,
    Message,
    MessageFlag,
    MessageType,
    new_error,
    new_method_call,
    new_method_return,
)
from jeepney.io.blocking import open_dbus_connection

AGENT = "/org/balboa_swarm/agent"
PROPERTIES = "org.freedesktop.DBus.Properties"
_BLUEZ = "org.bluez"
_AUTHENTICATED_S = 10.0


class BluezError(Exception):
    """A refusal by bluetoothd, or by the way to it; `name` is the error's name in D-Bus."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(text or name)
        self.name = name


class Bluez:
    """A connection to the system's bus, and what we ask bluetoothd there."""

    def __init__(self, adapter: str | None = None) -> None:
        """`adapter`: hci0, or the first; raises `BluezError` where there is no bus, no bluetoothd or no adapter."""
        self._peer: str | None = None
        try:
            self._connection = open_dbus_connection("SYSTEM", auth_timeout=_AUTHENTICATED_S)
        except (OSError, ValueError, RuntimeError) as error:
            raise BluezError("no-bus", f"no D-Bus: {error}") from None
        try:
            objects = self.objects()
            paths = sorted(path for path, interfaces in objects.items() if _BLUEZ + ".Adapter1" in interfaces)
        except BluezError:
            self.close()
            raise
        paths = [path for path in paths if adapter is None or path.endswith("/" + adapter)]
        if not paths:
            self.close()
            raise BluezError("no-adapter", "bluetoothd knows no Bluetooth adapter")
        self.adapter = paths[0]

    def close(self) -> None:
        """Close the connection, with which bluetoothd forgets our agent and our inquiry."""
        self._connection.close()

    # -- bluetoothd ------------------------------------------------------------------------------------------------

    def objects(self) -> dict[str, Any]:
        """Return all objects of bluetoothd: interfaces with their properties, by object path."""
        (found,) = self.call("/", "org.freedesktop.DBus.ObjectManager", "GetManagedObjects")
        return {path: {name: _plain(properties) for name, properties in each.items()} for path, each in found.items()}

    def state(self) -> dict[str, Any]:
        """Return the adapter's properties."""
        return dict(self.objects()[self.adapter][_BLUEZ + ".Adapter1"])

    def device(self, address: str) -> dict[str, Any] | None:
        """Return a device's properties; None where the adapter does not know it."""
        interfaces = self.objects().get(self.path(address), {})
        found = interfaces.get(_BLUEZ + ".Device1")
        return None if found is None else dict(found)

    def devices(self) -> list[dict[str, Any]]:
        """Return the properties of all devices of the adapter."""
        name = _BLUEZ + ".Device1"
        return [each[name] for path, each in self.objects().items() if name in each and path.startswith(self.adapter)]

    def path(self, address: str) -> str:
        """Return the object path of a device."""
        return f"{self.adapter}/dev_{address.upper().replace(':', '_')}"

    def set_adapter(self, name: str, value: bool) -> None:
        """Set one of the adapter's properties."""
        self.call(self.adapter, PROPERTIES, "Set", "ssv", [_BLUEZ + ".Adapter1", name, ("b", value)])

    def trust(self, address: str) -> None:
        """Let the device connect without questions."""
        self.call(self.path(address), PROPERTIES, "Set", "ssv", [_BLUEZ + ".Device1", "Trusted", ("b", True)])

    def forget(self, address: str) -> None:
        """Remove the device and its key."""
        self.call(self.adapter, _BLUEZ + ".Adapter1", "RemoveDevice", "o", [self.path(address)])

    def inquire(self) -> None:
        """Look for devices of Bluetooth Classic, until `stop_inquiry`."""
        body: list[Any] = [{"Transport": ("s", "bredr")}]
        self.call(self.adapter, _BLUEZ + ".Adapter1", "SetDiscoveryFilter", "a{sv}", body)
        self.call(self.adapter, _BLUEZ + ".Adapter1", "StartDiscovery")

    def stop_inquiry(self) -> None:
        """End the inquiry: a page and an inquiry at once get into each other's way."""
        self.call(self.adapter, _BLUEZ + ".Adapter1", "StopDiscovery")

    def pair(self, address: str, seconds: float) -> None:
        """Pair with a device that the adapter knows."""
        self.call(self.path(address), _BLUEZ + ".Device1", "Pair", seconds=seconds)

    def be_agent(self, peer: str) -> None:
        """Answer bluetoothd's questions: yes for `peer`, no for everybody else."""
        self._peer = self.path(peer)
        manager = _BLUEZ + ".AgentManager1"
        self.call("/org/bluez", manager, "RegisterAgent", "os", [AGENT, "NoInputNoOutput"])
        self.call("/org/bluez", manager, "RequestDefaultAgent", "o", [AGENT])

    def wait(self, done: Callable[[], bool], seconds: float, *, every: float = 0.3, stop: int | None = None) -> bool:
        """Answer questions until `done`, which is looked at each `every` s; False after `seconds`, or when the
        descriptor `stop` can be read."""
        end = time.monotonic() + seconds
        while not done():
            look = min(time.monotonic() + every, end)
            while (left := look - time.monotonic()) > 0:
                if stop is not None and select.select([stop], [], [], 0)[0]:
                    return False
                if (message := self._receive(left)) is not None:
                    self._answer(message)
            if time.monotonic() >= end:
                return done()
        return True

    # -- D-Bus -----------------------------------------------------------------------------------------------------

    def call(
        self,
        path: str,
        interface: str,
        member: str,
        signature: str = "",
        body: list[Any] | None = None,
        *,
        seconds: float = 30.0,
    ) -> tuple[Any, ...]:
        """Call a method of bluetoothd and return what it returns; raises `BluezError`."""
        message = new_method_call(DBusAddress(path, _BLUEZ, interface), member, signature or None, tuple(body or ()))
        message.header.flags |= MessageFlag.no_auto_start  # a service that does not run would be waited for in vain
        serial = next(self._connection.outgoing_serial)
        self._connection.send(message, serial=serial)
        end = time.monotonic() + seconds
        while (answer := self._receive(end - time.monotonic())) is not None:
            fields = answer.header.fields
            if fields.get(HeaderFields.reply_serial) != serial:
                self._answer(answer)
            elif answer.header.message_type is MessageType.error:
                raise BluezError(fields.get(HeaderFields.error_name, ""), str(answer.body[0]) if answer.body else "")
            else:
                return tuple(answer.body)
        raise BluezError("no-answer", f"bluetoothd has not answered {member} within {seconds:g} s")

    def _receive(self, seconds: float) -> Message | None:
        """Return the next message; None where none comes within that time."""
        try:
            return self._connection.receive(timeout=max(0.0, seconds))
        except TimeoutError:
            return None
        except OSError:
            raise BluezError("no-bus", "D-Bus has closed the connection") from None

    def _answer(self, message: Message) -> None:
        """Answer a call to our agent; signals, and answers that nobody waits for any more, are dropped."""
        if message.header.message_type is not MessageType.method_call:
            return
        fields = message.header.fields
        member = fields.get(HeaderFields.member, "")
        about = message.body[0] if message.body else None
        asks = member in ("RequestAuthorization", "RequestConfirmation", "AuthorizeService")
        if member in ("Release", "Cancel") or (asks and about == self._peer):
            self._connection.send(new_method_return(message))
        elif fields.get(HeaderFields.path) == AGENT and member.startswith(("Request", "Authorize", "Display")):
            self._connection.send(new_error(message, "org.bluez.Error.Rejected"))
        else:
            self._connection.send(new_error(message, "org.freedesktop.DBus.Error.UnknownMethod"))


def _plain(properties: dict[str, Any]) -> dict[str, Any]:
    """Return properties without the signatures of their values."""
    return {name: value for name, (_, value) in properties.items()}
