"""Inside a machine: which side of a connection is central, and what its radio tells, over a real kernel's Bluetooth."""

import contextlib
from collections.abc import Iterator

import pytest
from inside_faults import CHANNEL, accept, dial

from lab.radio.remote import Radio
from lab.waiting import until
from services.mesh.links import rfcomm, supervision
from services.mesh.links.pipe import Pipe
from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter


@pytest.fixture
def near(radio: Radio) -> Iterator[Adapter]:
    with contextlib.closing(Adapter(radio.addresses[0])) as adapter:
        yield adapter


@pytest.fixture
def far(radio: Radio) -> Iterator[Adapter]:
    with contextlib.closing(Adapter(radio.addresses[1])) as adapter:
        yield adapter


def hang_up(*pipes: Pipe) -> None:
    for pipe in pipes:
        pipe.shutdown()
        pipe.close()


@contextlib.contextmanager
def listening(radio: Radio, number: int, *, calls_all: bool) -> Iterator[rfcomm.RfcommListener]:
    listener = rfcomm.RfcommListener(rfcomm.Radio(radio.addresses[number], CHANNEL, calls_all=calls_all), {})
    with contextlib.closing(listener):
        yield listener


def test_who_calls_is_central(radio: Radio, near: Adapter, far: Adapter) -> None:
    with listening(radio, 1, calls_all=False) as listener:
        pipes = dial(radio), accept(listener)
        assert near.is_central(radio.addresses[1])
        assert not far.is_central(radio.addresses[0])
        hang_up(*pipes)


def test_who_calls_all_asks_to_be_central_where_it_is_called(radio: Radio, near: Adapter, far: Adapter) -> None:
    """The kernel does so by itself, since the listening socket says it."""
    with listening(radio, 1, calls_all=True) as listener:
        pipes = dial(radio), accept(listener)
        until("the called one is central", lambda: far.is_central(radio.addresses[0]))
        until("the caller is not", lambda: not near.is_central(radio.addresses[1]))
        hang_up(*pipes)


def test_who_calls_back_after_a_knock_has_the_roles_switched(radio: Radio, near: Adapter, far: Adapter) -> None:
    """The kernel keeps the knock's connection, and the call back goes over it. A time-out is the central's to set."""
    until("no connection of a test before", lambda: not radio.order("look")["links"])
    with listening(radio, 1, calls_all=False) as knocked, listening(radio, 0, calls_all=False) as calls_back:
        hang_up(dial(radio), accept(knocked))
        pipes = dial(radio, 1, 0), accept(calls_back)
        assert not far.is_central(radio.addresses[0]), "the connection is the knock's"
        supervision.limit(far, radio.addresses[0], 2.0)
        assert far.is_central(radio.addresses[0])
        until("the other side knows", lambda: not near.is_central(radio.addresses[1]))
        hang_up(*pipes)


def test_what_a_connection_tells(radio: Radio, near: Adapter) -> None:
    radio.order("change", rssi=-60)
    peer = radio.addresses[1]
    with listening(radio, 1, calls_all=False) as listener:
        pipes = dial(radio), accept(listener)
        told = [near.read(what, peer) for what in (hci.READ_RSSI, hci.READ_QUALITY, hci.READ_FAILED_CONTACTS)]
        assert told == [-60, 255, 0]
        hang_up(*pipes)
