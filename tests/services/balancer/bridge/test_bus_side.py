"""Which commands the bus side lets pass to the loop: none that moves the robot, from a stop until the mesh tells that
none holds."""

from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest

from services.balancer.bridge.bus_side import BusSide
from swarm.messages import Arm, SetLeds, SetMode, SetVelocity, Stop, Stopped
from swarm.messages.codec import encode
from swarm.messages.service import short_reason

TOLD = "swarm/r0/mesh/stopped"


class Bus:
    """Keeps what is subscribed, asked and published."""

    def __init__(self) -> None:
        self.heard: dict[str, Any] = {}
        self.asked: list[tuple[str, Any]] = []
        self.published: list[tuple[str, object]] = []
        self.changes: list[Any] = []

    def subscribe(self, keys: str | list[str], callback: Any) -> None:
        for each in [keys] if isinstance(keys, str) else keys:
            self.heard[each] = callback

    def on_change(self, callback: Any) -> None:
        self.changes.append(callback)

    def ask(self, key: str, on_reply: Any, **_: object) -> None:
        self.asked.append((key, on_reply))

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        self.published.append((key, message))


class Side:
    """A bus side whose loop keeps what it is given."""

    def __init__(self, *, stopped: bool = False) -> None:
        self.now = 100.0
        self.taken: list[object] = []
        self.bus = Bus()
        process: Any = SimpleNamespace(
            robot="r0", bus=self.bus, counters=Counter(), log=SimpleNamespace(warning=lambda *_: None)
        )
        loop: Any = SimpleNamespace(
            halt=self.taken.append, take=lambda command, _: self.taken.append(command) or True, show=self.taken.append
        )
        self.side = BusSide(process, lambda: self.now, loop, stopped=stopped)
        self.side.listen(lambda name, payload: self.side.command(name, payload, self.now))

    def hear(self, key: str, message: object) -> None:
        self.bus.heard[key](key, encode(message))

    def passes(self, message: object = SetMode("stand"), topic: str = "mode") -> bool:
        self.taken.clear()
        self.hear(f"swarm/r0/balancer/set/{topic}", message)
        return self.taken == [message]


@pytest.mark.parametrize(
    ("message", "topic"),
    [(SetMode("stand"), "mode"), (SetVelocity(0.1, 0.0, 1.0), "velocity")],
    ids=["mode", "velocity"],
)
def test_commands_that_move_the_robot_are_refused_while_a_stop_holds(message: object, topic: str) -> None:
    side = Side()
    assert side.passes(message, topic)
    side.hear("swarm/stop", Stop(99.0, "r1", "smoke", repeated=True))
    assert not side.passes(message, topic)
    assert side.passes(SetLeds(True, False, False), "leds")
    side.hear(TOLD, Stopped(99.9, False, {}))
    assert not side.passes(message, topic), "the mesh had not heard of the stop yet"
    side.hear(TOLD, Stopped(100.05, True, {"r1": "smoke"}))
    side.hear(TOLD, Stopped(100.1, False, {}))
    assert side.passes(message, topic)
    assert "swarm/stop" not in dict(side.bus.published)


def test_a_stop_that_the_mesh_has_not_heard_is_given_to_it_once_more() -> None:
    """It was published while the mesh was started anew, and nobody would repeat it."""
    side = Side()
    stop = Stop(99.0, "a program", "smoke")
    side.hear("swarm/stop", stop)
    side.now = 101.0
    side.hear(TOLD, Stopped(100.9, False, {}))
    assert side.bus.published == [("swarm/stop", stop)]
    assert not side.passes()
    side.hear(TOLD, Stopped(100.95, False, {}))
    assert not side.passes(), "told before the stop was given once more"
    # A mesh that knows it, and in which somebody takes it back.
    side.hear(TOLD, Stopped(101.1, True, {"r0": "smoke"}))
    side.hear(TOLD, Stopped(102.0, False, {}))
    assert side.passes()
    assert [name for name, _ in side.bus.published].count("swarm/stop") == 1


@pytest.mark.parametrize("earlier", ["r1", "r0"])
def test_a_stop_given_while_the_mesh_was_away_outlives_an_earlier_one_that_the_mesh_remembers(earlier: str) -> None:
    side = Side()
    side.hear("swarm/stop", Stop(99.0, "r1", "smoke", repeated=True))
    side.hear(TOLD, Stopped(100.1, True, {"r1": "smoke"}))
    side.now = 105.0  # the mesh is away
    stop = Stop(105.0, "a program", "fire")
    side.hear("swarm/stop", stop)
    side.now = 108.0
    side.hear(TOLD, Stopped(107.0, True, {earlier: "smoke"}))  # started anew, from its file
    assert side.bus.published == [("swarm/stop", stop)], "before somebody takes back those that the mesh knows"
    side.now = 109.0
    side.hear(TOLD, Stopped(108.1, True, {"r0": "fire", "r1": "smoke"}))
    side.hear(TOLD, Stopped(108.5, False, {}))
    assert side.passes()
    assert len(side.bus.published) == 1


@pytest.mark.parametrize("reason", ["fire", "", "f" * 70, "é" * 40 + "x", "x" + "é" * 40])
def test_a_stop_that_the_mesh_knows_is_not_given_again(reason: str) -> None:
    side = Side()
    side.hear("swarm/stop", Stop(99.0, "a program", reason))
    side.hear(TOLD, Stopped(99.9, True, {"r0": short_reason(reason), "r1": "smoke"}))
    side.now = 102.0
    side.hear(TOLD, Stopped(101.9, False, {}))
    assert side.bus.published == []
    assert side.passes()


def test_a_stop_that_was_taken_back_while_the_mesh_was_away_is_not_given_again() -> None:
    side = Side()
    arm = "swarm/r0/mesh/set/arm"
    side.hear("swarm/stop", Stop(99.0, "a program", "smoke"))
    side.now = 101.0
    side.hear(arm, Arm(101.0, "somebody", 5.0))  # given before the stop
    side.bus.heard[arm](arm, b"\xc1 no message")
    side.hear(TOLD, Stopped(100.9, False, {}))
    assert [name for name, _ in side.bus.published] == ["swarm/stop"]
    side = Side()
    side.hear("swarm/stop", Stop(99.0, "a program", "smoke"))
    side.now = 101.0
    side.hear(arm, Arm(101.0, "somebody", 0.5))
    assert not side.passes(), "the mesh has the last word"
    side.hear(TOLD, Stopped(3600.0, False, {}))
    assert side.passes()
    assert "swarm/stop" not in dict(side.bus.published)


@pytest.mark.parametrize("age", [0.0, 3.0])
def test_a_stop_given_after_a_rearm_is_given_to_the_mesh_that_was_away(age: float) -> None:
    side, arm = Side(), "swarm/r0/mesh/set/arm"
    first, later = Stop(99.0, "a program", "smoke"), Stop(105.0, "a program", "fire")
    side.hear("swarm/stop", first)
    side.now = 103.0
    if not age:
        side.hear(arm, Arm(103.0, "somebody", 0.0))
    side.now = 105.0
    side.hear("swarm/stop", later)
    if age:
        side.now = 106.0
        side.hear(arm, Arm(106.0, "somebody", age))
    side.now = 108.0
    side.hear(TOLD, Stopped(107.9, False, {}))
    assert side.bus.published == [("swarm/stop", later)]
    assert not side.passes()


def test_a_repetition_of_the_mesh_is_not_given_back_to_it() -> None:
    side = Side()
    side.hear(TOLD, Stopped(100.5, True, {"r1": "smoke"}))
    side.now = 101.0
    side.hear("swarm/stop", Stop(101.0, "r1", "smoke", repeated=True))
    side.now = 102.0
    side.hear(TOLD, Stopped(101.9, False, {}))
    assert side.bus.published == []
    assert side.passes()


def test_a_mesh_that_does_not_take_a_stop_locks_nobody_out_for_good() -> None:
    side = Side()
    side.hear("swarm/stop", Stop(99.0, "a program", "smoke"))
    side.hear(TOLD, Stopped(100.1, False, {}))
    side.hear(TOLD, Stopped(100.2, False, {}))
    assert side.passes()


def test_a_mesh_that_tells_of_a_stop_is_enough() -> None:
    """The stop itself may have been lost, or have come before this process."""
    side = Side()
    side.hear(TOLD, Stopped(99.0, True, {"r1": "smoke"}))
    assert not side.passes()
    side.hear(TOLD, Stopped(98.0, False, {}))
    assert not side.passes(), "older than the stop"
    side.hear(TOLD, Stopped(99.5, False, {}))
    assert side.passes()


def test_the_mesh_is_asked_whenever_the_bus_comes() -> None:
    side = Side()
    (change,) = side.bus.changes
    change(False)
    assert side.bus.asked == []
    change(True)
    ((name, answer),) = side.bus.asked
    assert name == TOLD
    answer(name, encode(Stopped(99.0, True, {"r1": "smoke"})))
    assert not side.passes()


def test_what_the_process_before_knew_holds_until_the_mesh_tells_otherwise() -> None:
    side = Side(stopped=True)
    assert not side.passes()
    side.hear(TOLD, Stopped(100.5, False, {}))
    assert side.passes()


def test_an_answer_that_cannot_be_read_changes_nothing() -> None:
    side = Side(stopped=True)
    side.bus.heard[TOLD](TOLD, b"\xc1")
    assert not side.passes()
