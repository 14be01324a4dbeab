"""The asynchronous overlay of several robots: barrier, periods, loss, delay, order and restarts."""

import pytest
from asynchronous_world import Process, World
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from swarm.core.asynchronous import (
    REPEAT,
    REPEAT_WAITING,
    HandlerCall,
)


def test_no_robot_steps_before_all_are_there() -> None:
    world = World(4, lambda *_: 0.03)
    options = {"period": 0.2, "barrier": True}
    processes = [world.start(name, **options) for name in ("r0", "r1", "r3")]
    world.run(10.0)
    assert [process.core.missing for process in processes] == [("r2", "r3"), ("r2", "r3"), ("r0", "r1", "r2")]
    assert {process.core.phase for process in processes} == {"waiting"}
    processes.append(world.start("r2", **options))
    world.run(2.0)
    first = [process.steps[0] for process in processes]
    assert min(first) >= 10.0
    assert max(first) <= 10.0 + 3 * 0.03 + 2 * REPEAT_WAITING
    assert {process.core.phase for process in processes} == {"running"}


def test_apps_without_a_barrier_wait_for_nobody() -> None:
    world = World(2)
    process = world.start("r0", period=0.2)
    world.run(1.0)
    assert len(process.steps) == 6
    assert process.core.phase == "running"


def test_each_robot_has_its_own_period() -> None:
    world = World(2, lambda *_: 0.03)
    slow, fast = (world.start(name, period=p, barrier=True) for name, p in (("r0", 0.5), ("r1", 0.05)))
    world.run(20.0)
    assert len(slow.steps) == pytest.approx(40, abs=2)
    assert len(fast.steps) == pytest.approx(400, abs=3)


fates = st.one_of(st.none(), st.floats(0.0, 2.0))


@costly(40)
@given(st.data())
def test_any_loss_delay_order_and_restart(data: st.DataObject) -> None:
    """For 10 s the air does what it likes; then it is well, and all is as it should be within seconds."""
    count = data.draw(st.integers(2, 5), label="robots")
    random = data.draw(st.randoms(use_true_random=False), label="air")

    def fate(sender: str, receiver: str) -> float | None:
        if world.now >= 10.0:
            return 0.01
        return None if random.random() < 0.4 else random.random() * 2.0

    def handler_time(name: str, call: HandlerCall) -> float:
        return random.random() * 0.3 if world.now < 10.0 else 0.0

    world = World(count, fate, handler_time)
    options = {"period": 0.1, "barrier": True}
    world.run(0.0)
    for name in world.names:
        world.at(random.random() * 5.0, lambda name=name: world.start(name, **options) and None)  # type: ignore[misc]
    kills = data.draw(
        st.lists(st.tuples(st.sampled_from(world.names), st.floats(5.0, 10.0)), max_size=4), label="kills"
    )
    for name, time in kills:
        world.at(time, lambda name=name: world.start(name, **options) and None)  # type: ignore[misc]
    world.run(10.0)
    assert all(process.core.counters["bad_frame"] == 0 for process in world.processes.values())
    world.run(6.0)
    settled = world.processes.values()
    assert {process.core.phase for process in settled} == {"running"}
    for process in settled:
        assert [known.name for known in process.core.known(16.0)] == list(process.core.neighbours)
        assert all(known.age <= REPEAT + 0.1 for known in process.core.known(16.0))
        check_order(process)
    # In good air each sees every state of its neighbours, and none is seen older than its link is.
    world.run(0.011)
    for process in settled:
        for known in process.core.known(world.now):
            there = world.processes[known.name]
            assert int.from_bytes(there.state, "little") - int.from_bytes(known.data, "little") in (0, 1)


def check_order(process: Process) -> None:
    """start first and once; a neighbour's states never go back within one incarnation of it."""
    assert [call.handler for _, call in process.calls].count("start") == 1
    assert process.calls[0][1].handler == "start"
    times = [time for time, _ in process.calls]
    assert times == sorted(times)


def test_states_of_one_process_never_go_back() -> None:
    delays = iter([0.5, 0.0, 0.3, 0.1, 0.7, 0.0] * 100)
    world = World(2, lambda *_: next(delays))
    world.start("r0", period=0.1)
    other = world.start("r1", handled=("on_neighbour",))
    world.run(10.0)
    values = [int.from_bytes(state, "little") for _, state in other.seen]
    assert values == sorted(values)
    assert other.core.counters["duplicate"] > 0


def test_a_restart_disturbs_nobody() -> None:
    world = World(3, lambda *_: 0.02)
    options = {"period": 0.1, "barrier": True}
    for name in world.names:
        world.start(name, **options)
    world.run(5.0)
    before = {name: len(process.steps) for name, process in world.processes.items()}
    killed = world.start("r1", **options)
    world.run(5.0)
    for name in ("r0", "r2"):
        assert len(world.processes[name].steps) - before[name] == 50
        assert world.processes[name].core.phase == "running"
    assert killed.steps[0] - 5.0 <= 0.1  # its neighbours tell it at once that all have been there
