"""Publishers find out whether somebody listens, and never keep a message from a listener for long."""

import gc
from types import SimpleNamespace

import pytest
from bus_samples import Open, Samples, talk
from conftest import wait_until

from swarm.bus.publisher import Publisher
from swarm.bus.zenoh_bus import Bus

pytest_plugins = ("bus_fixtures",)


@pytest.mark.usefixtures("bus_service")
def test_who_comes_later_hears_what_nobody_heard_before(open_bus: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("swarm.bus.publisher._CERTAIN_S", 0.0)
    alice, bob = open_bus(), open_bus()
    alice.wait_connected(None)
    publisher = ("swarm/r0/test/x", False)
    for _ in range(2):

        def alone() -> bool:
            alice.publish("swarm/r0/test/x", b"nobody hears this")
            return not alice._publishers[publisher].audience.there

        wait_until(alone)
        samples = Samples()
        subscription = bob.subscribe("swarm/r0/**", samples)
        wait_until(lambda: alice._publishers[publisher].audience.there)
        alice.publish("swarm/r0/test/x", b"once")
        what = ("swarm/r0/test/x", b"once")
        wait_until(lambda: what in samples, what="what was said once arrives")  # noqa: B023 - called within the round
        subscription.close()


def heard_by_another(open_bus: Open) -> tuple[Bus, Publisher, Samples]:
    """A client, its publisher of a key, and what another client hears of it."""
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/r0/test/x", samples)
    talk(alice, "swarm/r0/test/x", samples)
    return alice, alice._publishers["swarm/r0/test/x", False], samples


@pytest.mark.usefixtures("bus_service")
def test_a_key_is_not_silent_for_ever_when_the_word_that_somebody_listens_was_lost(
    open_bus: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("swarm.bus.publisher._CERTAIN_S", 0.0)
    alice, publisher, samples = heard_by_another(open_bus)
    publisher.audience.there = False
    talk(alice, "swarm/r0/test/x", samples, b"later")
    assert publisher.audience.there


@pytest.mark.usefixtures("bus_service")
def test_a_key_is_not_silent_where_zenoh_says_for_ever_that_nobody_listens(
    open_bus: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("swarm.bus.publisher._CERTAIN_S", 0.01)
    alice, publisher, samples = heard_by_another(open_bus)

    class Wrong:
        """What Zenoh has declared, and its word that nobody listens."""

        matching_status = SimpleNamespace(matching=False)
        put = publisher._publisher.put

    monkeypatch.setattr(publisher, "_publisher", Wrong)
    publisher.audience.there = False
    talk(alice, "swarm/r0/test/x", samples, b"later")
    assert not publisher.audience.there


@pytest.mark.usefixtures("bus_service")
def test_keys_that_nobody_uses_any_more_are_let_go(open_bus: Open) -> None:
    alice = open_bus()
    alice.wait_connected(None)
    wait_until(lambda: alice._session is not None)
    for number in range(300):
        alice.publish(f"swarm/r0/test/{number}", b"")
    assert len(alice._publishers) == 256
    gc.collect()
    assert sum(isinstance(each, Publisher) for each in gc.get_objects()) <= 256, "Zenoh holds none of them"


@pytest.mark.usefixtures("bus_service")
def test_a_stop_does_not_overtake_the_arming_that_was_published_before_it(open_bus: Open) -> None:
    alice = open_bus()
    alice.wait_connected(None)
    wait_until(lambda: alice._session is not None)
    stop, arm, other = "swarm/stop", "swarm/r0/mesh/set/arm", "swarm/r0/mesh/set/flood"
    for key in (arm, stop, other):
        alice.publish(key, b"", urgent=True)
    # Zenoh keeps the order within a priority, and only there.
    priority = {key: alice._publishers[key, True]._publisher.priority for key in (arm, stop, other)}
    assert priority[arm] == priority[stop]
    assert priority[stop] != priority[other], "a stop waits for no urgent message"
