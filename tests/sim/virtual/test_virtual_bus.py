"""The bus in memory does what `swarm.bus.zenoh_bus.Bus` does, at the present moment and never from within."""

import inspect

import pytest

from sim.virtual.bus import VirtualBus, VirtualRouter
from sim.virtual.events import EventQueue
from sim.virtual.periodic_publisher import PeriodicPublisher
from swarm.app.mesh_clock import MeshClock
from swarm.bus.protocol import BusLike
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.messages import Clock, Stop
from swarm.messages.codec import decode


@pytest.fixture
def router():
    return VirtualRouter(EventQueue())


def test_the_virtual_bus_has_the_methods_of_the_real_one():
    for name in dir(BusLike):
        if not name.startswith("_") and inspect.isfunction(method := getattr(Bus, name)):
            ours, real = inspect.signature(getattr(VirtualBus, name)), inspect.signature(method)
            assert ours.parameters == real.parameters, name
            assert (ours.return_annotation is None) == (real.return_annotation is None), name


def test_samples_reach_other_sessions_after_the_present_call(router):
    first, second, seen = VirtualBus(router), VirtualBus(router), []
    for bus, name in ((first, "first"), (second, "second")):
        bus.subscribe(["swarm/*/app/**", "swarm/stop"], lambda *sample, name=name: seen.append((name, *sample)))
    first.publish("swarm/r0/app/x/sync/1", b"frame")
    second.publish("swarm/stop", Stop(1.0, "r0", "why"))
    second.publish("swarm/r0/mesh/links", b"nobody hears")
    assert seen == []
    router.time.run()
    assert seen[0] == ("second", "swarm/r0/app/x/sync/1", b"frame")
    assert seen[1][:2] == ("first", "swarm/stop")
    assert decode(Stop, seen[1][2], "swarm/stop") == Stop(1.0, "r0", "why")
    assert len(seen) == 2


def test_who_subscribes_later_hears_later_samples(router):
    first, second, seen = VirtualBus(router), VirtualBus(router), []
    first.publish("swarm/r0/x/y", b"1")
    assert not first.wanted("swarm/r0/x/y")
    second.subscribe("swarm/r0/**", lambda *sample: seen.append(sample))
    assert first.wanted("swarm/r0/x/y")
    assert not second.wanted("swarm/r0/x/y")
    first.publish("swarm/r0/x/y", b"2")
    router.time.run()
    assert seen == [("swarm/r0/x/y", b"2")]
    second.close()
    first.publish("swarm/r0/x/y", b"3")
    router.time.run()
    assert len(seen) == 1


def test_a_closed_subscription_hears_no_more(router):
    first, second, seen = VirtualBus(router), VirtualBus(router), []
    closed = second.subscribe(["swarm/r0/x/y", "swarm/r0/z/*"], lambda *sample: seen.append(("closed", *sample)))
    second.subscribe("swarm/r0/x/y", lambda *sample: seen.append(("open", *sample)))
    closed.close()
    closed.close()
    first.publish("swarm/r0/x/y", b"1")
    first.publish("swarm/r0/z/1", b"2")
    router.time.run()
    assert seen == [("open", "swarm/r0/x/y", b"1")]


def test_queries_are_answered_and_tokens_seen(router):
    first, second, seen = VirtualBus(router), VirtualBus(router), []
    first.serve("swarm/r0/x/row", lambda key, asked: b"row " + asked["sequence"].encode() if asked else None)
    second.ask("swarm/r0/x/row", lambda *reply: seen.append(reply), sequence=3)
    second.ask("swarm/r0/x/row", lambda *reply: seen.append(reply))
    first.announce("swarm/r0/x/alive")
    second.watch("swarm/*/*/alive", lambda *token: seen.append(token))
    first.announce("swarm/r0/y/alive")
    router.time.run()
    assert seen == [("swarm/r0/x/row", b"row 3"), ("swarm/r0/x/alive", True), ("swarm/r0/y/alive", True)]


def test_a_session_that_ends_answers_nobody_and_leaves_nothing(router):
    dead, other, seen = VirtualBus(router), VirtualBus(router), []
    other.watch("swarm/*/*/alive", lambda *token: seen.append(token))
    dead.announce("swarm/r0/x/alive")
    dead.serve("swarm/r0/x/status", lambda *_: b"dead")
    PeriodicPublisher(router.time, dead, ("swarm/r0/x/a",), 1.0, 1.0, lambda: None)
    router.time.run(2.0)
    dead.close()
    other.ask("swarm/r0/x/status", lambda *answer: seen.append(answer))
    router.time.run(4.0)
    assert seen == [("swarm/r0/x/alive", True), ("swarm/r0/x/alive", False)]
    assert (router.servers, router.tokens, router.waiting, router.sessions) == ({}, [], [], [other])


def test_what_the_real_bus_refuses_it_refuses(router):
    first, second = VirtualBus(router), VirtualBus(router)
    heard: list[str] = []
    second.subscribe("swarm/**", lambda key, _: heard.append(key))
    with pytest.raises(LocalError, match="longer"):
        first.publish("swarm/r0/" + "x" * 300, b"")
    first.publish("swarm/r0/x/y", bytes(1 << 20))
    assert first.counters["too_large"] == 1
    router.time.run()
    assert heard == []


def test_clients_of_the_bus_run_on_it(router):
    mesh, app = VirtualBus(router), VirtualBus(router)
    clock = MeshClock(app, "r0", lambda: router.time.now + 2.0)
    mesh.publish("swarm/r0/mesh/clock", Clock(2.0, 5.0, 0.0, "r0", 0, 0.0))
    router.time.run()
    assert clock.state is not None
    assert clock.root == "r0"
    assert clock.now() == 7.0
