"""The fixture of the bus' tests; test modules name this file in `pytest_plugins`."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_samples import Open

from swarm.bus.zenoh_bus import Bus


@pytest.fixture
def open_bus(runtime: Path) -> Iterator[Open]:
    """Opens sessions that are closed with the test."""
    opened: list[Bus] = []

    def open_one() -> Bus:
        opened.append(Bus.of(runtime))
        return opened[-1]

    yield open_one
    for bus in opened:
        bus.close()
