"""`rehearse`: what apps print and log is seen, each line with its robot; a test that would do nothing is refused."""

import math

import pytest

from swarm import EventApp, SyncApp, rehearse
from swarm.errors import AppError, LocalError


class Speaks(SyncApp):
    x: float

    def start(self) -> None:
        print("begins")  # noqa: T201

    def step(self, neighbours: object) -> None:
        print("at", self.k, end="")  # noqa: T201
        print(" now")  # noqa: T201
        self.robot.log.warning("x is %g", self.x)


class Answers(EventApp):
    on: bool

    def start(self) -> None:
        self.robot.log.info("begins")

    def on_button(self, button: str) -> None:
        print(button)  # noqa: T201


def test_lines_of_steps_are_seen_with_their_robots(capsys: pytest.CaptureFixture[str]) -> None:
    swarm = rehearse(Speaks, robots=2, values={"x": [3.0, 4.0]})
    swarm.run(1)
    lines = [line.split(" s  ")[1] for line in capsys.readouterr().out.splitlines()]
    for robot, x in (("r0", 3), ("r1", 4)):
        mine = [line for line in lines if line.startswith(robot)]
        assert mine == [f"{robot}  begins", f"{robot}  at 0 now", f"{robot}  warning: x is {x}"]
    assert len(lines) == 6


def test_lines_of_handlers_are_seen_with_their_robots(capsys: pytest.CaptureFixture[str]) -> None:
    swarm = rehearse(Answers, robots=2)
    swarm.run(1.0)
    print("mine")  # noqa: T201
    swarm.units["r1"].press("b")
    swarm.run(2.0)
    lines = [line.split(" s  ")[-1] for line in capsys.readouterr().out.splitlines()]
    assert lines == ["r0  begins", "r1  begins", "mine", "r1  b"]


class Heard(SyncApp):
    """Counts messages and changes of the members."""

    heard: int = 0
    changes: int = 0

    def step(self, neighbours: object) -> None:
        if self.k == 0 and self.robot.name == "r0":
            self.robot.flood(b"hello")
        self.heard += len(self.robot.messages())

    def on_epoch(self, members: object) -> None:
        self.changes += 1


def test_a_flood_of_a_rehearsed_app_takes_the_time_of_its_way() -> None:
    swarm = rehearse(Heard, robots=4)
    swarm.run(3)
    assert [swarm.result(f"r{index}")["heard"] for index in range(4)] == [0, 1, 1, 0]
    swarm.run(3)
    assert [swarm.result(f"r{index}")["heard"] for index in range(4)] == [0, 1, 1, 1]


def test_a_robot_that_is_taken_out_is_gone_on_without() -> None:
    swarm = rehearse(Heard, robots=4, topology="loop")
    swarm.run(5)
    swarm.drop("r2")
    assert swarm.names == ("r0", "r1", "r3")
    assert swarm.k == 5
    with pytest.raises(LocalError, match="drop: expected one of several robots, r0, r1, r3; got 'r2'"):
        swarm.drop("r2")
    swarm.run(10)
    assert [swarm.result(name)["changes"] for name in swarm.names] == [1, 1, 1]


class Breaks(EventApp):
    on: bool

    def on_button(self, button: str) -> None:
        raise ValueError(button)


def test_an_error_of_a_handler_is_raised() -> None:
    swarm = rehearse(Breaks, robots=2)
    swarm.run(1.0)
    swarm.units["r1"].press("b")
    with pytest.raises(AppError, match=r"Breaks on r1, .*ValueError: b"):
        swarm.run(2.0)
    assert "ValueError: b" in swarm.units["r1"].fault


@pytest.mark.parametrize("robots", [0, -1, 2.5, "3"])
def test_a_swarm_without_robots_is_refused(robots: object) -> None:
    with pytest.raises(AppError, match="robots: expected a whole number above zero, got"):
        rehearse(Speaks, robots=robots)  # type: ignore[arg-type]


@pytest.mark.parametrize("iterations", [-1, 2.5, "3"])
def test_a_number_of_iterations_that_is_none_is_refused(iterations: object) -> None:
    with pytest.raises(LocalError, match="run: expected a number of iterations, got"):
        rehearse(Speaks, robots=2).run(iterations)  # type: ignore[arg-type]


@pytest.mark.parametrize("until", [2.0, 1.0, -1.0, math.nan])
def test_a_time_that_is_over_is_refused(until: float) -> None:
    swarm = rehearse(Answers, robots=2)
    swarm.run(2.0)
    with pytest.raises(LocalError, match="run: expected a time since the start, of more than 2 s; got"):
        swarm.run(until)


def test_a_button_that_a_robot_does_not_have_is_named() -> None:
    with pytest.raises(LocalError, match="no button 'Z', there are A, B, C"):
        rehearse(Answers, robots=2).units["r0"].press("z")
