"""Hosts of apps as a test starts them, what they are asked, and what an undisturbed run gives."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import conftest
import pytest
from apps_rig import NAMES, Rig
from memory_swarm import MeasurementOf, MemorySwarm, config_of

from swarm.messages.codec import decode

START = "".join(f"[apps.consensus.robots.r{i}]\nvalue = {x}\n" for i, x in enumerate((0.5, 3.0, 5.0)))
MakeRig = Callable[..., Rig]


@pytest.fixture
def make_rig(runtime: Path) -> Iterator[MakeRig]:
    rigs: list[Rig] = []

    def make(more: str = START, names: tuple[str, ...] = NAMES, own_bus: tuple[str, ...] = ()) -> Rig:
        rigs.append(Rig(runtime, names, more, own_bus))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.__exit__()


def undisturbed(
    app: str,
    last: int,
    parameters: Any = None,
    robots: Any = None,
    measure: MeasurementOf | None = None,
    count: int = 3,
) -> dict[str, list[str]]:
    """What the same run gives in memory, in the words of a recording."""
    config = config_of(count, app=app, parameters=parameters, robots=robots, anchors=())
    swarm = MemorySwarm(app, config, last, measure)
    return {
        name: [
            ",".join(_words({**state, **{f"r {n}": v for n, v in result.items()}}))
            for state, result in zip(swarm.states[name], swarm.results[name], strict=True)
        ]
        for name in config.names
    }


def _words(values: dict[str, Any]) -> Iterator[str]:
    for value in values.values():
        yield from map(repr, value if isinstance(value, tuple) else (value,))


def consensus(last: int) -> dict[str, list[str]]:
    return undisturbed("consensus", last, robots={f"r{i}": {"value": x} for i, x in enumerate((0.5, 3.0, 5.0))})


def ask(rig: Rig, robot: str, topic: str, kind: type) -> Any:
    return decode(kind, conftest.ask(rig.buses[robot], f"swarm/{robot}/app/{topic}"), topic)
