"""What is measured under a load has that load, and a stop finds a robot that moves."""

import sys
import threading
from types import MappingProxyType, SimpleNamespace

import pytest

from bench.balancer import balancer
from bench.rigs.running import lasting
from bench.stop import robots, stop
from bench.stop.body import TRUTH
from swarm import clock
from swarm.errors import LocalError


def test_a_load_that_ends_by_itself_is_an_error() -> None:
    with (
        pytest.raises(LocalError, match="ended by itself, with code 3"),
        lasting([sys.executable, "-c", "exit(3)"]) as it,
    ):
        it.wait(30.0)
    with lasting([sys.executable, "-c", "input()"], stdin=-1):
        pass


def test_a_load_that_fails_in_its_thread_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(balancer, "SETTLE_S", 0.0)
    monkeypatch.setattr(balancer, "_cyclictest", lambda seconds: [1e-5])

    def act() -> None:
        raise LocalError("no load")

    with pytest.raises(LocalError, match="no load"):
        balancer._phase("flood", 1.0, act)


class Robots:
    """Buses that nothing is behind."""

    buses = MappingProxyType({"r0": None, "r3": None})


@pytest.mark.parametrize(
    ("arrives", "error"), [(True, None), (False, "no megabyte"), (TimeoutError, "no megabyte"), (KeyError, "what")]
)
def test_stops_beside_a_transfer_have_one_beside_them(
    monkeypatch: pytest.MonkeyPatch, arrives: object, error: str | None
) -> None:
    sent = threading.Event()

    class Overlays:
        def __init__(self, *_: object) -> None:
            pass

        def on_message(self, take: object) -> None:
            pass

        def send(self, *_: object, **__: object) -> "Overlays":
            return self

        def result(self, timeout: float) -> SimpleNamespace:
            sent.set()
            if not isinstance(arrives, bool):
                raise arrives("what")  # type: ignore[operator]
            return SimpleNamespace(delivered=arrives)

    monkeypatch.setattr(stop, "Overlays", Overlays)
    monkeypatch.setattr(stop, "FLOOD_SETTLES_S", 0.0)

    def under_load() -> None:
        with stop._transfer(Robots()):  # type: ignore[arg-type]
            assert sent.wait(30.0)

    if error is None:
        under_load()
    else:
        with pytest.raises((LocalError, KeyError), match=error):
            under_load()


class OneRobot(robots.RobotsOnALine):
    """r0 without its processes: it stands up at once, and says what the test has it say."""

    def _start(self) -> None:
        pass

    def _stand_up(self) -> None:
        self._take_truth(TRUTH.pack(clock.now(), True) + b"balancing")

    def switched_off(self, at: float) -> None:
        self._take_truth(TRUTH.pack(at, False) + robots.FAULT.encode())
        self._said = clock.now(), robots.FAULT


def test_a_stop_of_a_robot_that_has_fallen_by_itself_before_is_given_again() -> None:
    given: list[float] = []
    with OneRobot() as robot:

        def give() -> float:
            now = clock.now()
            given.append(now)
            robot.switched_off(now - 0.001 if len(given) == 1 else now + 0.005)
            return now

        found = robot.stop(give)
    assert len(given) == 2
    assert found is not None
    assert found[0] == pytest.approx(0.005)


def test_a_robot_that_always_falls_by_itself_is_an_error() -> None:
    def give() -> float:
        now = clock.now()
        robot.switched_off(now - 0.001)
        return now

    with OneRobot() as robot, pytest.raises(LocalError, match="fell by itself"):
        robot.stop(give)
