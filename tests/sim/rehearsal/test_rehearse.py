"""`rehearse`: what apps print and log is seen, each line with its robot."""

import pytest

from swarm import EventApp, SyncApp, rehearse


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
    begun = ["r0  begins", "r1  begins"]
    assert lines == [*begun, "r0  at 0 now", "r0  warning: x is 3", "r1  at 0 now", "r1  warning: x is 4"]


def test_lines_of_handlers_are_seen_with_their_robots(capsys: pytest.CaptureFixture[str]) -> None:
    swarm = rehearse(Answers, robots=2)
    swarm.run(1.0)
    print("mine")  # noqa: T201
    swarm.units["r1"].press("b")
    swarm.run(2.0)
    lines = [line.split(" s  ")[-1] for line in capsys.readouterr().out.splitlines()]
    assert lines == ["r0  begins", "r1  begins", "mine", "r1  b"]
