"""Several bluetoothds and the air between them, for Debian's own Python (python3-dbus, python3-gi).

    /usr/bin/python3 fake_bluetoothd.py SPEC.json

SPEC: {"robots": {name: {bus, address, paired: [names], away: bool, deaf: bool}}, "log": FILE}. What is played is what
bluez 5.66 does: temporary devices come by discovery of what is discoverable, Pair asks the other side's default agent
by RequestAuthorization, a side that has lost its key fails with AuthenticationFailed, a radio does one pairing at a
time.
"""

import json
import sys

import dbus
import dbus.bus
import dbus.mainloop.glib
import dbus.service
from gi.repository import GLib

ADAPTER, DEVICE, MANAGER = "org.bluez.Adapter1", "org.bluez.Device1", "org.bluez.AgentManager1"
PROPERTIES = "org.freedesktop.DBus.Properties"
HCI = "/org/bluez/hci0"
AIR_MS = 60


def error(name: str) -> dbus.DBusException:
    return dbus.DBusException(name, name=f"org.bluez.Error.{name}")


class Root(dbus.service.Object):
    """The object manager."""

    def __init__(self, radio: "Radio") -> None:
        super().__init__(radio.conn, "/")
        self.radio = radio

    @dbus.service.method("org.freedesktop.DBus.ObjectManager", out_signature="a{oa{sa{sv}}}")
    def GetManagedObjects(self):
        found = {HCI: {ADAPTER: self.radio.adapter.values, PROPERTIES: dbus.Dictionary({}, "sv")}}
        found.update({device.path: {DEVICE: device.values} for device in self.radio.devices.values()})
        return dbus.Dictionary({dbus.ObjectPath(path): each for path, each in found.items()}, "oa{sa{sv}}")


class Agents(dbus.service.Object):
    def __init__(self, radio: "Radio") -> None:
        super().__init__(radio.conn, "/org/bluez")
        self.radio = radio

    @dbus.service.method(MANAGER, in_signature="os", sender_keyword="sender")
    def RegisterAgent(self, path, capability, sender):
        assert capability == "NoInputNoOutput"
        self.radio.agents[sender] = path
        self.radio.conn.watch_name_owner(sender, lambda owner: owner or self.radio.agents.pop(sender, None))

    @dbus.service.method(MANAGER, in_signature="o", sender_keyword="sender")
    def RequestDefaultAgent(self, path, sender):
        self.radio.default = sender


class Values(dbus.service.Object):
    """An object with properties."""

    @dbus.service.method(PROPERTIES, in_signature="ssv")
    def Set(self, interface, name, value):
        if name not in self.values:
            raise error("InvalidArguments")
        self.values[name] = value


class Adapter(Values):
    def __init__(self, radio: "Radio", address: str) -> None:
        super().__init__(radio.conn, HCI)
        self.radio = radio
        flags = dict.fromkeys(("Powered", "Discoverable", "Pairable", "Discovering"), False)
        self.values = dbus.Dictionary({"Address": address, "Name": radio.name, **flags}, signature="sv")

    @dbus.service.method(ADAPTER, in_signature="a{sv}")
    def SetDiscoveryFilter(self, given):
        assert given == {"Transport": "bredr"}

    @dbus.service.method(ADAPTER)
    def StartDiscovery(self):
        if not self.values["Powered"]:
            raise error("NotReady")
        self.values["Discovering"] = True
        GLib.timeout_add(AIR_MS, self.radio.look_around)

    @dbus.service.method(ADAPTER)
    def StopDiscovery(self):
        self.values["Discovering"] = False

    @dbus.service.method(ADAPTER, in_signature="o")
    def RemoveDevice(self, path):
        for address, device in list(self.radio.devices.items()):
            if device.path == path:
                device.remove_from_connection()
                del self.radio.devices[address]
                return
        raise error("DoesNotExist")


class Device(Values):
    def __init__(self, radio: "Radio", other: "Radio") -> None:
        self.path = f"{HCI}/dev_{other.address.replace(':', '_')}"
        super().__init__(radio.conn, self.path)
        self.radio, self.other = radio, other
        flags = dict.fromkeys(("Paired", "Bonded", "Trusted", "Connected"), False)
        self.values = dbus.Dictionary({"Address": other.address, "Adapter": HCI, **flags}, signature="sv")

    @dbus.service.method(DEVICE, async_callbacks=("done", "failed"))
    def Pair(self, done, failed):
        radio, other = self.radio, self.other
        if self.values["Paired"]:
            raise error("AlreadyExists")
        if radio.busy or other.busy:
            radio.note("asked twice at once")
            raise error("InProgress")
        radio.busy = other.busy = True
        radio.note(f"calls {other.name}")

        def end(name: str = "") -> None:
            radio.busy = other.busy = False
            if name:
                failed(error(name))
                return
            for device in (self, other.devices[radio.address]):
                device.values.update({"Paired": True, "Bonded": True})
            done()

        def arrives() -> bool:
            known = other.devices.get(radio.address)
            if not (other.here and other.adapter.values["Powered"] and other.adapter.values["Pairable"]):
                end("ConnectionAttemptFailed")
            elif known is not None and known.values["Paired"]:
                end("AuthenticationFailed")  # it wants the key that we have lost
            elif other.default not in other.agents:
                end("AuthenticationRejected")
            else:
                device = other.know(radio)
                agent = other.conn.get_object(other.default, other.agents[other.default], introspect=False)
                agent.RequestAuthorization(
                    dbus.ObjectPath(device.path), dbus_interface="org.bluez.Agent1",
                    reply_handler=end, error_handler=lambda _: end("AuthenticationRejected"),
                )  # fmt: skip
            return False

        GLib.timeout_add(AIR_MS, arrives)


class Radio:
    """One robot's adapter and its bluetoothd."""

    def __init__(self, name: str, spec: dict, log) -> None:
        self.name, self.address, self.here, self.log = name, spec["address"], not spec.get("away"), log
        self.conn = dbus.bus.BusConnection(spec["bus"])
        self.devices: dict[str, Device] = {}
        self.agents: dict[str, str] = {}
        self.default = ""
        self.busy = False
        self.others: list[Radio] = []
        self.adapter = Adapter(self, self.address)
        self.objects = [Root(self), Agents(self)]
        if not spec.get("deaf"):
            self.owner = dbus.service.BusName("org.bluez", self.conn)

    def note(self, text: str) -> None:
        self.log.write(f"{self.name} {text}\n")
        self.log.flush()

    def know(self, other: "Radio") -> Device:
        if other.address not in self.devices:
            self.devices[other.address] = Device(self, other)
        return self.devices[other.address]

    def look_around(self) -> bool:
        for other in self.others:
            if other.here and other.adapter.values["Discoverable"]:
                self.know(other)
        return bool(self.adapter.values["Discovering"])


def main() -> None:
    with open(sys.argv[1]) as file:  # noqa: PTH123
        spec = json.load(file)
    dbus.mainloop.glib.DBusGMainLoop(set_as_default=True)
    with open(spec["log"], "a") as log:  # noqa: PTH123
        radios = {name: Radio(name, each, log) for name, each in spec["robots"].items()}
        for radio in radios.values():
            radio.others = [other for other in radios.values() if other is not radio]
            for name in spec["robots"][radio.name].get("paired", ()):
                radio.know(radios[name]).values.update({"Paired": True, "Bonded": True, "Trusted": True})
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        GLib.MainLoop().run()


main()
