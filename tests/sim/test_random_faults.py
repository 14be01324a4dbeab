"""Fifty random faults against six robots of real processes: all go on, with the same values, and nothing is lost."""

import copy
from collections import Counter
from pathlib import Path

import pytest

from bench.faults import random_faults, restless_rule
from bench.faults.restless import swing
from bench.faults.restless_rule import Epoch
from swarm.core.graph import Graph
from swarm.messages import AppEpoch, AppState
from swarm.recording.core.writer import Writer


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_swarm_survives_fifty_random_faults(capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(random_faults.rows(random_faults.Sizes(50, seed=20)))
    with capsys.disabled():
        print("", *(row.text() for row in rows), sep="\n")  # noqa: T201 - figures of this machine
    # How long a pause is depends on the machine, which has two cores for thirty processes here.
    assert [row.name for row in rows if not row.ok and not row.name.startswith("longest pause")] == []
    assert next(row.value for row in rows if row.name == "reboots among them") > 0


STARTS = {"r0": 0.0, "r1": 0.5}


def test_the_swing_is_a_triangle_of_period_four() -> None:
    assert [swing(0, phase) for phase in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0)] == [0.0, 0.5, 1.0, 0.0, -1.0, 0.0]
    assert swing(1, 0.0) == pytest.approx(0.37)


def two_epochs() -> dict[int, Epoch]:
    """Robots 0 and 1 do a step; then r1 reboots, and both do another one from where they are."""
    pair = Graph(("r0", "r1"), [("r0", "r1")])
    # Half of the difference, as Metropolis has it for two; the swing on top: 0 for r0, 1 for r1.
    r0 = [(0.0, 0), (0.25, 1)]
    r1 = [(0.5, 0), (0.5 - 0.25 + 1.0, 1)]
    before = Epoch(0, 0, pair, {}, {"r0": dict(enumerate(r0)), "r1": dict(enumerate(r1))})
    # r0 goes on from its x(1), where the swing's 0.37 is next; r1 from its start.
    after = Epoch(1, 1, pair, {}, {"r0": {1: (0.25, 1), 2: (0.375 + swing(1, 0.0), 2)}, "r1": {1: (0.5, 0)}})
    return {0: before, 7: after}


def test_what_the_rule_gives_is_right() -> None:
    found = restless_rule.compare(two_epochs(), STARTS)
    assert (found.wrong, found.compared, found.unknown) == ([], 7, 0)
    assert found.anew == Counter(r1=1)


@pytest.mark.parametrize(
    ("number", "robot", "k"), [(0, "r0", 0), (0, "r1", 1), (7, "r0", 1), (7, "r0", 2), (7, "r1", 1)]
)
def test_a_value_that_differs_in_its_last_bit_is_found(number: int, robot: str, k: int) -> None:
    epochs = copy.deepcopy(two_epochs())
    value, n = epochs[number].states[robot][k]
    epochs[number].states[robot][k] = value + 1e-16 + value * 2.3e-16, n
    assert restless_rule.compare(epochs, STARTS).wrong


def test_a_value_that_is_missing_is_no_difference_and_stands_for_what_was_lost() -> None:
    epochs = two_epochs()
    del epochs[0].states["r1"][1]
    epochs[0].states["r0"][2] = (0.25 + 0.5 * (0.5 - 0.25 + 1.0 - 0.25) + swing(1, 0.0), 2)
    assert restless_rule.compare({0: epochs[0]}, STARTS).wrong == []
    assert restless_rule.lost({0: epochs[0]}) == 1
    del epochs[7].states["r1"][1]
    found = restless_rule.compare({7: epochs[7]}, STARTS)
    assert found.unknown == 1


def test_recordings_are_read_epoch_by_epoch(tmp_path: Path) -> None:
    writer, state = Writer("test", epoch_ns=0), "swarm/r0/app/restless/state"

    def step(t: float, k: int, value: float, n: int) -> None:
        writer.write(state, t, AppState(t, k, {"value": value}, {"n": n}))

    step(1.0, 0, 0.0, 0)
    step(2.0, 1, 0.25, 1)
    links = (("r0", "r1"),)
    epoch = AppEpoch(3.0, 1, 1, ("r0", "r1"), links, (), forced=False, frames=7)
    writer.write("swarm/r0/app/restless/epoch", 3.0, epoch)
    step(4.0, 1, 0.25, 1)
    step(5.0, 1, 0.75, 1)
    path = tmp_path / "r0.restless.mcap"
    path.write_bytes(b"".join(writer.finish()))
    pair = Graph(("r0", "r1"), list(links))
    first, second = restless_rule.read({"r0": [path]}, pair).values()
    assert (first.counter, first.first, first.states) == (0, 0, {"r0": {0: (0.0, 0), 1: (0.25, 1)}})
    assert (second.counter, second.first, second.graph.edges) == (1, 1, links)
    assert second.states == {"r0": {1: (0.25, 1)}}
    assert second.forks == ["r0 has (0.25, 1) and (0.75, 1) at 1 of epoch 7"]
