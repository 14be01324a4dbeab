"""Devices and their meshes are found by PyBluez, where it is installed."""

import socket
import types

import pytest
from rfcomm_air import RfcommAir
from rfcomm_rig import A, B, air, listener

from services.mesh.links import pybluez, rfcomm
from swarm.errors import LocalError

__all__ = ["air", "listener"]


def test_without_pybluez_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "bluetooth", None)
    with pytest.raises(LocalError, match="PyBluez is not installed: apt install python3-bluez"):
        pybluez.discover(1.0, ask_services=False)


class PyBluezSocket(socket.socket):
    """Knows of itself whether its own `listen` was called, whatever the kernel's socket behind it does (btmodule.c)."""

    listens = False

    def bind(self, address: tuple[str, int]) -> None:
        assert address == ("", 0)

    def listen(self, backlog: int) -> None:
        self.listens = True


@pytest.fixture
def bluetooth(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """A module with the calls of PyBluez 0.23 that are used."""
    module = types.SimpleNamespace(
        RFCOMM=3,
        SERIAL_PORT_CLASS="1101",
        SERIAL_PORT_PROFILE=("1101", 0x0100),
        advertised=[],
        BluetoothSocket=lambda protocol: PyBluezSocket(socket.AF_UNIX),
        discover_devices=lambda duration, flush_cache, lookup_names: [(B.lower(), "raspberrypi"), (A, "phone")],
        find_service=lambda uuid, address: (
            [{"protocol": "L2CAP", "port": 3}, {"protocol": "RFCOMM", "port": 1}] if address == B.lower() else []
        ),
    )

    def advertise_service(sock: PyBluezSocket, *names: str, **ids: object) -> None:
        if not sock.listens:
            raise OSError("must have already called socket.listen()")
        module.advertised.append((sock.getsockname(), names, ids))

    module.advertise_service = advertise_service
    monkeypatch.setitem(__import__("sys").modules, "bluetooth", module)
    return module


def test_devices_in_range_and_their_meshes_are_found(bluetooth: types.SimpleNamespace) -> None:
    phone, robot = pybluez.discover(5.0, ask_services=True)
    assert (phone.address, phone.channel) == (A, None)
    assert (robot.address, robot.name, robot.channel) == (B, "raspberrypi", 1)


def test_the_adapter_that_looks_can_be_chosen(
    bluetooth: types.SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = types.SimpleNamespace(hci_devid=lambda name: 1 if name in ("hci1", A) else -1)
    monkeypatch.setitem(__import__("sys").modules, "bluetooth._bluetooth", inner)
    asked: list[int] = []

    def discover_devices(device_id: int = -1, **_: object) -> list[tuple[str, str]]:
        asked.append(device_id)
        return []

    bluetooth.discover_devices = discover_devices
    for name in ("", "hci1", A):
        assert pybluez.discover(1.28, ask_services=False, adapter=name) == []
    assert asked == [-1, 1, 1]
    with pytest.raises(LocalError, match="there is no Bluetooth adapter hci7"):
        pybluez.discover(1.28, ask_services=False, adapter="hci7")


def test_the_record_is_that_of_the_listening_socket(
    bluetooth: types.SimpleNamespace, air: RfcommAir, listener: rfcomm.RfcommListener
) -> None:
    record = pybluez.Record(listener.fileno())
    ((address, names, ids),) = bluetooth.advertised
    assert address.decode() == air.listening[B, 1]
    assert names == (pybluez.SERVICE_NAME,)
    assert ids["service_id"] == pybluez.SERVICE
    record.close()
