"""A swarm that starts slowly is waited for, and one that starts no further is given up."""

from sim.core.patience import START_LIMIT_S, Patience


def test_a_swarm_that_becomes_ready_slowly_is_waited_for() -> None:
    patience = Patience(0.0)
    assert not any(patience.lost(ready, ready * (START_LIMIT_S - 1.0)) for ready in range(1, 40))


def test_a_swarm_whose_services_come_and_go_is_given_up() -> None:
    patience = Patience(0.0)
    assert not patience.lost(3, 10.0)
    assert not patience.lost(2, 40.0)
    assert not patience.lost(3, 10.0 + START_LIMIT_S)
    assert patience.lost(3, 10.1 + START_LIMIT_S)
