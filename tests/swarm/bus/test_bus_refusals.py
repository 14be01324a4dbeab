"""What the bus adapter refuses: keys, messages and endpoints."""

from pathlib import Path

import pytest
from bus_samples import Open, Samples, talk

from swarm.bus.zenoh_bus import Bus, Router
from swarm.errors import BusError, LocalError
from swarm.messages import AppOutput
from swarm.messages.codec import MAX_BINARY, MAX_PAYLOAD
from swarm.process.paths import bus_endpoint

pytest_plugins = ("bus_fixtures",)


@pytest.mark.usefixtures("bus_service")
def test_the_bus_refuses_an_oversized_key(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    talk(alice, "swarm/r0/test/x", samples)
    long = "swarm/r0/test/" + "x" * 65536
    nothing = Samples()
    for attempt in (
        lambda: alice.publish(long, b""),
        lambda: alice.subscribe(long, nothing),
        lambda: alice.ask(long, nothing),
        lambda: alice.serve(long, lambda *_: None),
        lambda: alice.announce(long),
        lambda: alice.watch(long, nothing),
    ):
        with pytest.raises(LocalError):
            attempt()
    talk(alice, "swarm/r0/test/" + "x" * 200, samples, bytes(MAX_BINARY))


@pytest.mark.usefixtures("bus_service")
def test_the_bus_drops_and_counts_an_oversized_message_and_logs_it_once(
    open_bus: Open, caplog: pytest.LogCaptureFixture
) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    talk(alice, "swarm/r0/test/x", samples)
    large = AppOutput(1.0, {"value": "x" * MAX_PAYLOAD})
    for message in (bytes(MAX_BINARY + 1), large, large):
        alice.publish("swarm/r0/test/x", message)
    assert alice.counters["too_large"] == 3
    assert [record.message for record in caplog.records if "swarm/r0/test/x" in record.message] == [
        f"dropped, here and whenever it happens again: key=swarm/r0/test/x {MAX_BINARY + 1} bytes, "
        f"the bus takes at most {MAX_BINARY}"
    ]
    talk(alice, "swarm/r0/test/x", samples, b"the next message comes")


@pytest.mark.parametrize("key", ["", "/swarm", "swarm//x", "swarm/#", "swarm/x?y", "swarm/**/**/$", "swarm/"])
def test_malformed_keys_are_refused_at_once(open_bus: Open, key: str) -> None:
    bus = open_bus()
    for attempt in (
        bus.announce,
        lambda key: bus.subscribe(key, Samples()),
        lambda key: bus.ask(key, Samples()),
    ):
        with pytest.raises(LocalError, match="key"):
            attempt(key)


@pytest.mark.usefixtures("bus_service")
def test_publishing_under_a_malformed_key_is_logged(open_bus: Open, caplog: pytest.LogCaptureFixture) -> None:
    bus = open_bus()
    assert bus.wait_connected(60)
    bus.publish("swarm//x", b"")
    assert "put failed key=swarm//x" in caplog.text


@pytest.mark.parametrize("endpoint", ["", "tcp/127.0.0.1:7447", "/run/swarm/bus.sock"])
def test_other_endpoints_are_refused(endpoint: str) -> None:
    for kind in (Bus, Router):
        with pytest.raises(BusError, match="expected unixsock-stream/PATH"):
            kind(endpoint)


def test_runtime_directories_zenoh_would_misread_are_refused(runtime: Path) -> None:
    with pytest.raises(BusError, match="cannot have '#' in its path"):
        bus_endpoint(runtime / "a#b")
    with pytest.raises(BusError, match="at most 107"):
        bus_endpoint(runtime / ("x" * 100))
    strange = runtime / "a b;c=ü"
    strange.mkdir()
    with Router(bus_endpoint(strange)):
        assert (strange / "bus.sock").is_socket()
