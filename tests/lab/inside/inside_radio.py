"""Inside a machine, as a plugin of pytest (`-p inside_radio`): six adapters of its own kernel, and their air."""

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from lab.radio.remote import Radio
from lab.waiting import until

ROBOTS = 6
SCAN_WINDOW, SCAN_INTERVAL = 18, 512
"""Slots of a page scan, and from one to the next: as provisioning has them."""
SUPERVISION = 4.0
"""s; the standard's 20 s are for patient tests."""


def hci(number: int, *words: str) -> str:
    """What hciconfig says to these words about that adapter."""
    return subprocess.run(["hciconfig", f"hci{number}", *words], capture_output=True, text=True, check=True).stdout


def adapters() -> dict[str, int]:
    """Number of the adapter with each address."""
    said = subprocess.run(["hciconfig"], capture_output=True, text=True, check=True).stdout
    found: dict[str, int] = {}
    for part in said.split("hci")[1:]:
        found[part.split("BD Address: ")[1].split()[0]] = int(part.split(":")[0])
    return found


def bring_up(radio: Radio) -> None:
    """All adapters can be connected to; without bluetoothd nobody else does that."""
    until("the kernel has all adapters", lambda: set(radio.addresses) <= set(adapters()), state=adapters)
    for number in adapters().values():
        hci(number, "up")
        hci(number, "sspmode", "0")
        hci(number, "pageparms", f"{SCAN_WINDOW}:{SCAN_INTERVAL}")
        hci(number, "piscan")


@pytest.fixture(scope="session", autouse=True)
def radio() -> Iterator[Radio]:
    subprocess.run(["modprobe", "-a", "rfcomm", "hci_vhci"], check=True)
    with tempfile.TemporaryDirectory() as folder, Radio(Path(folder), ROBOTS, machines=False) as made:
        made.order("change", supervision=SUPERVISION)
        bring_up(made)
        yield made
        counts = made.order("look")["counts"]
    assert not [name for name in counts if name.startswith("unknown")], counts
    assert "BUG:" not in subprocess.run(["dmesg"], capture_output=True, text=True, check=True).stdout


@pytest.fixture(autouse=True)
def _whole_again(radio: Radio) -> Iterator[None]:
    """Each test begins with a whole air, whatever the one before did."""
    yield
    radio.order("topology", edges=[[a, b] for a in radio.addresses for b in radio.addresses if a < b])
    for address in radio.addresses:
        radio.order("unsilence", address=address)
    radio.order("change", supervision=SUPERVISION, rssi=0)
