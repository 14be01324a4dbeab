"""Inside a machine: what PyBluez finds through an adapter of our choice, and that the mesh does without it."""

import sys

import pytest
from inside_radio import adapters

from lab.radio.remote import Radio
from services.mesh.links import pybluez, rfcomm
from swarm.errors import LocalError


def test_each_adapter_finds_whom_it_hears(radio: Radio) -> None:
    one, two, three, four = radio.addresses[:4]
    radio.order("topology", edges=[[one, two], [three, four]])
    for adapter, other in ((three, four), (f"hci{adapters()[one]}", two)):
        found = pybluez.discover(2.56, ask_services=False, adapter=adapter)
        assert [each.address for each in found] == [other], adapter


def test_an_adapter_that_is_not_there(radio: Radio) -> None:
    with pytest.raises(LocalError, match="no Bluetooth adapter hci77"):
        pybluez.discover(1.28, ask_services=False, adapter="hci77")


def test_links_need_no_pybluez(radio: Radio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bluetooth", None)
    with pytest.raises(LocalError, match="apt install python3-bluez"):
        pybluez.discover(1.28, ask_services=False)
    listener = rfcomm.RfcommListener(rfcomm.Radio(radio.addresses[1], 5), {})
    rfcomm.dial(rfcomm.Radio(radio.addresses[0], 5), radio.addresses[1]).close()
    listener.close()
