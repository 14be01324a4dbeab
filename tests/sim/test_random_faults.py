"""Fifty random faults against six robots of real processes: all go on, with the same values, and nothing is lost."""

import pytest

from bench import random_faults


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_fifty_random_faults(capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(random_faults.rows(50, seed=20))
    with capsys.disabled():
        print("", *(row.text() for row in rows), sep="\n")  # noqa: T201 - figures of this machine
    # How long a pause is depends on the machine, which has two cores for thirty processes here.
    assert [row.name for row in rows if not row.ok and row.name != "longest pause"] == []


def test_the_rule_is_the_apps() -> None:
    """A value that differs in its last bit is found, and one that is missing is no difference."""
    from swarm.recording.trajectory import Trajectory

    def paths(*values: str) -> dict[str, Trajectory]:
        rows = {k: (value,) for k, value in enumerate(values)}
        path = {"r0": Trajectory(("value",), dict.fromkeys(rows, 0.0), rows)}
        return path | {name: Trajectory(("value",)) for name in random_faults.NAMES[1:]}

    # r0 with its neighbours r1 (0.1) and r5 (0.5), a third of the way to each: 0.2, and sin(0) = 0 on top.
    expected = sum(1 / 3 * (value - 0.0) for value in (0.1, 0.5))
    assert random_faults._differing(paths("0.0", repr(expected))) == 0
    assert random_faults._differing(paths("0.0", repr(expected + 1e-16))) == 1
