"""When `swarm mesh epoch` says that robots agree on who is in a run."""

import pytest

from swarm.messages import AppEpoch
from swarm.onboard.mesh.epoch import _agree


def epoch(number: int, members: str, away: str = "") -> AppEpoch:
    return AppEpoch(1.0, number, 10 * number, tuple(members.split()), (), tuple(away.split()), False, number)


@pytest.mark.parametrize(
    ("told", "agree"),
    [
        ({"r0": epoch(1, "r0 r1"), "r1": epoch(1, "r0 r1")}, True),
        ({"r0": epoch(2, "r0 r1"), "r1": epoch(1, "r0 r1")}, False),
        ({"r0": epoch(2, "r0 r1", "r2"), "r1": epoch(2, "r0 r1", "r2"), "r2": epoch(1, "r0 r1", "r2")}, True),
        ({"r0": epoch(1, "r0 r1", "r2"), "r1": epoch(1, "r0 r1", "r2"), "r2": epoch(0, "r0 r1 r2")}, False),
        ({"r0": epoch(1, "r0"), "r1": epoch(2, "r1")}, False),
    ],
    ids=["all", "one is late", "who was sent away is late", "who was sent away does not know it", "two halves"],
)
def test_members_agree_whatever_one_tells_that_knows_it_was_sent_away(told: dict[str, AppEpoch], agree: bool) -> None:
    assert _agree(told) == agree
