import pytest
from conftest import wait_until

from swarm.app.ranging import Ranging
from swarm.app.robot import Robot
from swarm.bus.zenoh_bus import Bus
from swarm.core.graph import Graph
from swarm.core.ranging import FRESH, RangeTable
from swarm.errors import AppError
from swarm.messages import Range, Ranges


def message(*items, t=1000.0):
    """(anchor, distance, age, robot) each."""
    return Ranges(t, 7, tuple(Range(a, d, d, 100, age, 3, age > 0.5, robot) for a, d, age, robot in items))


def test_own_ranges_age_and_are_forgotten():
    table = RangeTable("r0")
    assert table.ranges(0.0) == ()
    table.take("r0", message(("D001", 1.5, 0.0, None), ("DE01", 0.4, 0.3, "r1"), ("D002", 2.0, 0.6, None)), 10.0)
    assert [(item.anchor, item.age) for item in table.ranges(10.2)] == [
        ("D001", pytest.approx(0.2)),
        ("DE01", pytest.approx(0.5)),
    ]
    assert [item.anchor for item in table.ranges(10.0 + FRESH)] == ["D001"]
    assert table.ranges(10.1 + FRESH) == ()


def test_the_distance_to_a_robot_is_measured_by_either():
    table = RangeTable("r0")
    assert table.distance("r1", 0.0) is None
    table.take("r0", message(("DE01", 0.4, 0.3, "r1"), ("D001", 9.9, 0.0, None)), 10.0)
    assert table.distance("r1", 10.0) == 0.4
    assert table.distance("r2", 10.0) is None
    # what the other has measured counts by when it came: its clock is its own
    table.take("r1", message(("DE00", 0.45, 0.1, "r0"), ("DE02", 3.0, 0.0, "r2"), t=5.0), 10.0)
    assert table.distance("r1", 10.0) == 0.45
    table.take("r0", message(("DE01", 0.5, 0.0, "r1")), 10.1)
    assert table.distance("r1", 10.1) == 0.5
    assert table.distance("r1", 11.5) is None


def test_an_app_gets_ranges_over_the_bus(router, runtime):
    with Bus.of(runtime) as bus, Bus.of(runtime) as service:
        assert bus.wait_connected(60)
        assert service.wait_connected(60)
        robot = Robot("r0", Graph(("r0", "r1"), (("r0", "r1"),)), ranging=Ranging(bus, "r0"))

        def told():
            service.publish("swarm/r0/dwm/ranges", b"\xc1 nonsense")
            service.publish("swarm/r0/dwm/ranges", message(("DE01", 0.4, 0.0, "r1")))
            return robot.ranges

        wait_until(told, what="ranges")
        assert [(item.robot, item.distance) for item in robot.ranges] == [("r1", 0.4)]
        assert robot.distance("r1") == 0.4
        with pytest.raises(AppError, match="the robots are r0, r1"):
            robot.distance("r9")


def test_without_a_bus_it_says_so():
    robot = Robot("r0", Graph(("r0", "r1"), (("r0", "r1"),)))
    for call in (lambda: robot.ranges, lambda: robot.distance("r1")):
        with pytest.raises(AppError, match="needs a bus"):
            call()
