"""bluetoothd over D-Bus: adapters, devices, and an agent that says yes to one device and no to all others.

BlueZ's interfaces org.bluez.Adapter1, Device1, AgentManager1 and Agent1 (org.bluez.*(5)). One thread: while an answer
is waited for, bluetoothd's questions to the agent are answered.
"""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Callable
from typing import Any

from swarm.onboard.bootstrap import dbus_wire as wire
from swarm.onboard.bootstrap.dbus_wire import DbusMessage

SYSTEM_BUS = "unix:path=/run/dbus/system_bus_socket"
AGENT = "/org/balboa_swarm/agent"
PROPERTIES = "org.freedesktop.DBus.Properties"
_BLUEZ = "org.bluez"


class BluezError(Exception):
    """bluetoothd, or the way to it, says no; `name` is D-Bus' for it."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(text or name)
        self.name = name


class Bluez:
    """A connection to the system's bus, and what we ask bluetoothd there."""

    def __init__(self, adapter: str | None = None) -> None:
        """`adapter`: hci0, or the first; raises `BluezError` where there is no bus, no bluetoothd or no adapter."""
        self._serial = 0
        self._data = b""
        self._peer: str | None = None
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._connect(os.environ.get("DBUS_SYSTEM_BUS_ADDRESS") or SYSTEM_BUS)
            objects = self.objects()
        except OSError as error:
            self.close()
            raise BluezError("no-bus", f"no D-Bus: {error}") from None
        except BluezError:
            self.close()
            raise
        paths = sorted(path for path, interfaces in objects.items() if _BLUEZ + ".Adapter1" in interfaces)
        if adapter is not None:
            paths = [path for path in paths if path.endswith("/" + adapter)]
        if not paths:
            self.close()
            raise BluezError("no-adapter", "bluetoothd knows no Bluetooth adapter")
        self.adapter = paths[0]

    def close(self) -> None:
        """bluetoothd forgets our agent and our inquiry with the connection."""
        self._sock.close()

    # -- bluetoothd ------------------------------------------------------------------------------------------------

    def objects(self) -> dict[str, Any]:
        """All that bluetoothd has: interfaces with their properties, by object path."""
        (found,) = self.call("/", "org.freedesktop.DBus.ObjectManager", "GetManagedObjects")
        return {path: {name: _plain(properties) for name, properties in each.items()} for path, each in found.items()}

    def state(self) -> dict[str, Any]:
        """The adapter's properties."""
        return dict(self.objects()[self.adapter][_BLUEZ + ".Adapter1"])

    def device(self, address: str) -> dict[str, Any] | None:
        """A device's properties; None where the adapter does not know it."""
        interfaces = self.objects().get(self.path(address), {})
        found = interfaces.get(_BLUEZ + ".Device1")
        return None if found is None else dict(found)

    def devices(self) -> list[dict[str, Any]]:
        """All devices of the adapter."""
        name = _BLUEZ + ".Device1"
        return [each[name] for path, each in self.objects().items() if name in each and path.startswith(self.adapter)]

    def path(self, address: str) -> str:
        """The object path of a device."""
        return f"{self.adapter}/dev_{address.upper().replace(':', '_')}"

    def set_adapter(self, name: str, signature: str, value: Any) -> None:
        """Set one of the adapter's properties."""
        body = [_BLUEZ + ".Adapter1", name, (signature, value)]
        self.call(self.adapter, PROPERTIES, "Set", "ssv", body)

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
        """End it; a page and an inquiry at once get into each other's way."""
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
                watched: list[Any] = [self._sock] if stop is None else [self._sock, stop]
                ready = select.select(watched, [], [], left)[0]
                if stop in ready:
                    return False
                if ready:
                    self._read()
                    self._answer_all()
            if time.monotonic() >= end:
                return done()
        return True

    # -- D-Bus -----------------------------------------------------------------------------------------------------

    def call(
        self, path: str, interface: str, member: str, signature: str = "", body: list[Any] | None = None,
        *, to: str = _BLUEZ, seconds: float = 30.0,
    ) -> list[Any]:  # fmt: skip
        """Call a method and return what it returns; raises `BluezError`."""
        self._serial += 1
        serial = self._serial
        fields = {"path": path, "interface": interface, "member": member, "destination": to}
        if signature:
            fields["signature"] = signature
        self._send(DbusMessage(wire.CALL, serial, fields, body or []))
        end = time.monotonic() + seconds
        while True:
            for message in self._messages():
                if message.kind in (wire.RETURN, wire.ERROR) and message.fields.get("reply_to") == serial:
                    if message.kind == wire.ERROR:
                        text = str(message.body[0]) if message.body else ""
                        raise BluezError(message.fields.get("error", ""), text)
                    return message.body
                self._answer(message)
            left = end - time.monotonic()
            if left <= 0 or not select.select([self._sock], [], [], left)[0]:
                raise BluezError("no-answer", f"bluetoothd has not answered {member} within {seconds:g} s")
            self._read()

    def _connect(self, addresses: str) -> None:
        for address in addresses.split(";"):
            kind, _, rest = address.partition(":")
            options = dict(option.partition("=")[::2] for option in rest.split(","))
            if kind == "unix" and "path" in options:
                self._sock.connect(options["path"])
                break
        else:
            raise BluezError("no-bus", f"no D-Bus: cannot use the address {addresses}")
        self._sock.settimeout(10)
        self._sock.sendall(b"\0AUTH EXTERNAL " + str(os.geteuid()).encode().hex().encode() + b"\r\n")
        said = b""
        while not said.endswith(b"\r\n"):
            data = self._sock.recv(256)
            if not data:
                break
            said += data
        if not said.startswith(b"OK "):
            raise BluezError("no-bus", f"D-Bus does not let us in: {said.decode(errors='replace').strip()}")
        self._sock.sendall(b"BEGIN\r\n")
        self.call("/org/freedesktop/DBus", "org.freedesktop.DBus", "Hello", to="org.freedesktop.DBus")

    def _send(self, message: DbusMessage) -> None:
        self._sock.sendall(wire.encode(message))

    def _read(self) -> None:
        data = self._sock.recv(1 << 16)
        if not data:
            raise BluezError("no-bus", "D-Bus has closed the connection")
        self._data += data

    def _messages(self) -> list[DbusMessage]:
        found = []
        while (length := wire.size(self._data)) is not None and length <= len(self._data):
            found.append(wire.decode(self._data[:length]))
            self._data = self._data[length:]
        return found

    def _answer_all(self) -> None:
        for message in self._messages():
            self._answer(message)

    def _answer(self, message: DbusMessage) -> None:
        """Answer a call to our agent; signals, and answers that nobody waits for any more, are dropped."""
        if message.kind != wire.CALL:
            return
        self._serial += 1
        fields = {"reply_to": message.serial, "destination": message.fields.get("sender", "")}
        member = message.fields.get("member", "")
        about = message.body[0] if message.body else None
        asks = member in ("RequestAuthorization", "RequestConfirmation", "AuthorizeService")
        if member in ("Release", "Cancel") or (asks and about == self._peer):
            self._send(DbusMessage(wire.RETURN, self._serial, fields))
        elif message.fields.get("path") == AGENT and member.startswith(("Request", "Authorize", "Display")):
            self._send(DbusMessage(wire.ERROR, self._serial, {**fields, "error": "org.bluez.Error.Rejected"}))
        else:
            unknown = "org.freedesktop.DBus.Error.UnknownMethod"
            self._send(DbusMessage(wire.ERROR, self._serial, {**fields, "error": unknown}))


def _plain(properties: dict[str, Any]) -> dict[str, Any]:
    """Values without their signatures."""
    return {name: value for name, (_, value) in properties.items()}
