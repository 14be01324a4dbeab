"""When `swarm mesh epoch` says that robots agree on who is in a run."""

from collections.abc import Callable

import pytest

from swarm.errors import LocalError
from swarm.messages import AppEpoch, GraphRobot, MeshGraph
from swarm.messages.codec import encode
from swarm.onboard.buses.ask import Answers
from swarm.onboard.mesh import epoch as epoch_command
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


class OneMesh:
    """A bus whose mesh knows r0 to r3, if it answers."""

    def __init__(self, *, answers: bool = True) -> None:
        self._answers = answers

    def ask(self, key: str, take: Callable[[str, bytes], None], **_: object) -> None:
        robots = tuple(GraphRobot(f"r{n}", "here", 0.0, None, None, {}, None) for n in range(4))
        if self._answers:
            take(key, encode(MeshGraph(1.0, robots, more=False)))


def test_a_name_that_no_robot_has_is_no_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(epoch_command, "PATIENCE", 0.0)

    def check(bus: OneMesh, *names: str) -> None:
        answers = Answers[AppEpoch]({"r0": bus}, AppEpoch, "app/x", "epoch")  # type: ignore[dict-item]
        answers.newest["r0"] = epoch(1, "r0 r1", "r2")
        epoch_command._check(answers, names)

    check(OneMesh(), "r1", "r2", "r3")  # r3 has not come yet
    check(OneMesh(answers=False), "r1", "r2")
    with pytest.raises(LocalError, match=r"^no robot 'r9' in the swarm, there are r0, r1, r2, r3$"):
        check(OneMesh(), "r1", "r9")
    with pytest.raises(LocalError, match=r"^no robot 'r3' in the swarm, there are r0, r1, r2$"):
        check(OneMesh(answers=False), "r3")
