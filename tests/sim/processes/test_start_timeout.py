"""A swarm that starts slowly is waited for, and one that starts no further is given up."""

from sim.processes.monitor import START_LIMIT_S, StartTimeout


def test_a_swarm_that_becomes_ready_slowly_is_waited_for() -> None:
    start_timeout = StartTimeout(0.0)
    assert not any(start_timeout.lost(ready, ready * (START_LIMIT_S - 1.0)) for ready in range(1, 40))


def test_a_swarm_whose_services_come_and_go_is_given_up() -> None:
    start_timeout = StartTimeout(0.0)
    assert not start_timeout.lost(3, 10.0)
    assert not start_timeout.lost(2, 40.0)
    assert not start_timeout.lost(3, 10.0 + START_LIMIT_S)
    assert start_timeout.lost(3, 10.1 + START_LIMIT_S)
