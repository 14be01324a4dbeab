"""What is told at intervals is told at the same moments as by a plain timer, whenever somebody begins to hear it, and
nothing is planned while nobody does."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.virtual.bus import VirtualBus, VirtualRouter
from sim.virtual.events import EventQueue, LocalTime
from sim.virtual.periodic_publisher import PeriodicPublisher

KEYS = ("swarm/r0/balancer/odometry", "swarm/r0/balancer/state")
PERIOD = 0.04
END = 3.0

CLOCKS = {
    "the world's": lambda world: world,
    "its own": lambda world: LocalTime(world, 1234.5, -3e-5),
}


def plain(world, time, first):
    """When a timer calls that knows nothing of hearers."""
    seen = []

    def call():
        seen.append((world.now, time.now))
        time.at(time.now + PERIOD, call)

    time.at(time.now + first, call)
    return seen


@pytest.mark.parametrize("clock", CLOCKS)
@given(
    first=st.floats(0.0, PERIOD),
    spans=st.lists(st.tuples(st.floats(0.001, 0.9), st.sampled_from(KEYS)), max_size=4),
    gap=st.floats(0.001, 0.5),
)
def test_a_periodic_publisher_calls_when_a_plain_timer_does_while_somebody_hears(clock, first, spans, gap):
    world = EventQueue()
    time = CLOCKS[clock](world)
    router = VirtualRouter(world)
    teller, hearer = VirtualBus(router), VirtualBus(router)
    expected, seen = plain(world, time, first), []
    PeriodicPublisher(time, teller, KEYS, PERIOD, time.now + first, lambda: seen.append((world.now, time.now)))
    heard, at = [], 0.0
    for length, key in spans:
        begin, end = at + gap, at + gap + length
        heard.append((begin, end))
        at = end

        def listen(key=key, end=end):
            world.at(end, hearer.subscribe(key, print).close)

        world.at(begin, listen)
    world.run(END)
    # What falls on the very moment of a change may come or not.
    sure = [each for each in expected if any(begin < each[0] < end for begin, end in heard)]
    assert [each for each in seen if each in sure] == sure
    assert all(any(begin <= now <= end for begin, end in heard) for now, _ in seen)


def test_a_periodic_publisher_costs_nothing_while_nobody_hears():
    world = EventQueue()
    router = VirtualRouter(world)
    teller, hearer = VirtualBus(router), VirtualBus(router)
    PeriodicPublisher(world, teller, KEYS, PERIOD, 0.01, pytest.fail)
    world.run(END)
    assert world.done == 1
    hearer.subscribe("swarm/r0/dwm/pose", print)
    world.run(2 * END)
    assert world.done == 1
    teller.close()
    hearer.subscribe(KEYS[0], print)
    world.run(3 * END)
    assert world.done == 1
