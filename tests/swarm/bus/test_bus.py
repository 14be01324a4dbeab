"""The bus adapter against a real router process: what holds over its death, its stop and its restart."""

import gc
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import Processes, wait_until

from swarm.bus import zenoh_bus
from swarm.bus.publisher import Publisher
from swarm.bus.zenoh_bus import Bus, Router
from swarm.errors import BusError, LocalError
from swarm.messages import AppOutput, Leds, Stop, read
from swarm.messages.codec import MAX_BINARY, MAX_PAYLOAD
from swarm.messages.service import MAX_STOP_TEXT
from swarm.process.paths import ENDPOINT_PROTOCOL, bus_endpoint

Open = Callable[[], Bus]

HELD_UP = 4.0
"""s that a call takes which waits for Zenoh. A busy machine may hold up one call for as long, but not one after the
other, as Zenoh does."""


@pytest.fixture
def open_bus(runtime: Path) -> Iterator[Open]:
    """Opens sessions that are closed with the test."""
    opened: list[Bus] = []

    def open_one() -> Bus:
        opened.append(Bus.of(runtime))
        return opened[-1]

    yield open_one
    for bus in opened:
        bus.close()


class Samples(list[tuple[str, bytes]]):
    """A subscriber's callback that keeps what came."""

    def __call__(self, key: str, payload: bytes) -> None:
        self.append((key, payload))


def talk(bus: Bus, key: str, samples: Samples, payload: bytes = b"hello") -> None:
    """Publish until `samples` has it: a subscription takes effect a moment after it was declared."""

    def arrived() -> bool:
        bus.publish(key, payload)
        return (key, payload) in samples

    wait_until(arrived, what=f"{key} arrives")


@pytest.mark.usefixtures("bus_service")
def test_a_message_travels_typed(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    talk(alice, "swarm/r0/test/x", samples)
    alice.publish("swarm/r0/balancer/leds", Leds(1.0, red=True, yellow=False, green=True), urgent=True)
    wait_until(lambda: "swarm/r0/balancer/leds" in dict(samples))
    assert read("swarm/r0/balancer/leds", dict(samples)["swarm/r0/balancer/leds"]) == Leds(1.0, True, False, True)


@pytest.mark.usefixtures("bus_service")
def test_a_stop_that_is_too_large_or_cannot_be_packed_arrives_empty(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe(("swarm/stop", "swarm/r0/test/x"), samples)
    talk(alice, "swarm/r0/test/x", samples)
    for stop in (bytes(900_000), bytes(2_000_000), Stop(0.0, "\ud800", ""), object()):
        count = len(samples)
        alice.publish("swarm/stop", stop)
        wait_until(lambda: ("swarm/stop", b"") in samples[count:], what="the stop")  # noqa: B023
    alice.publish("swarm/stop", Stop(1.0, "r0", "x" * 100_000))
    wait_until(lambda: samples[-1][1] not in (b"", b"hello"))
    assert read(*samples[-1]) == Stop(1.0, "r0", "x" * MAX_STOP_TEXT)


@pytest.mark.usefixtures("bus_service")
def test_own_messages_do_not_come_back(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    own, other = Samples(), Samples()
    alice.subscribe("swarm/r0/test/**", own)
    bob.subscribe("swarm/r0/test/**", other)
    talk(alice, "swarm/r0/test/x", other)
    talk(bob, "swarm/r0/test/y", own)
    assert {key for key, _ in own} == {"swarm/r0/test/y"}


@pytest.mark.usefixtures("bus_service")
def test_what_is_heard_no_more(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    once, on = Samples(), Samples()
    unused = bob.subscribe("swarm/r0/test/y", once)
    unused.close()  # declared or not yet
    subscription = bob.subscribe(["swarm/r0/test/x", "swarm/r0/test/y"], once)
    talk(alice, "swarm/r0/test/x", once)
    subscription.close()
    subscription.close()
    bob.subscribe("swarm/r0/test/x", on)
    heard = len(once)
    talk(alice, "swarm/r0/test/x", on, b"later")
    assert len(once) == heard


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
def test_one_callback_hears_several_keys_once(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe(["swarm/r0/a/x", "swarm/r0/b/*"], samples)
    for key in ("swarm/r0/a/x", "swarm/r0/b/y"):
        talk(alice, key, samples)
    alice.publish("swarm/r0/c/z", b"")
    talk(alice, "swarm/r0/a/x", samples, b"last")
    assert "swarm/r0/c/z" not in {key for key, _ in samples}


@pytest.mark.usefixtures("bus_service")
def test_queries_carry_parameters_and_may_stay_unanswered(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    asked: list[dict[str, str]] = []

    def answer(_: str, parameters: dict[str, str]) -> bytes | None:
        asked.append(parameters)
        return b"row 7" if parameters.get("sequence") == "7" else None

    bob.serve("swarm/r0/dwm/measurement", answer)
    replies = Samples()

    def answered() -> bool:
        alice.ask("swarm/r0/dwm/measurement", replies, sequence=8)
        alice.ask("swarm/r0/dwm/measurement", replies, sequence=7)
        return bool(replies)

    wait_until(answered)
    assert set(replies) == {("swarm/r0/dwm/measurement", b"row 7")}
    assert {"sequence": "8"} in asked


@pytest.mark.usefixtures("bus_service")
def test_tokens_come_and_go(open_bus: Open) -> None:
    alice, bob, late = open_bus(), open_bus(), open_bus()
    events = Samples()
    alice.watch("swarm/*/*/alive", events)
    bob.announce("swarm/r0/mesh/alive")
    wait_until(lambda: ("swarm/r0/mesh/alive", True) in events)
    history = Samples()
    late.watch("swarm/*/*/alive", history)
    wait_until(lambda: ("swarm/r0/mesh/alive", True) in history)
    bob.close()
    wait_until(lambda: ("swarm/r0/mesh/alive", False) in events)


def test_declared_before_the_router_is_there(open_bus: Open, processes: Processes) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    alice.publish("swarm/r0/test/x", b"lost")
    assert not alice.connected
    assert not alice.wait_connected(0.0)
    processes.router()
    assert alice.wait_connected(60)
    talk(alice, "swarm/r0/test/x", samples)


def test_everything_works_again_after_the_router_was_killed(
    open_bus: Open, processes: Processes, bus_service: subprocess.Popen[str]
) -> None:
    alice, bob = open_bus(), open_bus()
    changes: list[bool] = []
    alice.on_change(changes.append)
    samples, replies, tokens = Samples(), Samples(), Samples()
    bob.subscribe("swarm/r0/test/**", samples)
    bob.serve("swarm/r0/test/question", lambda *_: b"answer")
    bob.announce("swarm/r0/test/alive")
    alice.watch("swarm/*/*/alive", tokens)
    for round_ in (1, 2):
        talk(alice, "swarm/r0/test/x", samples)

        def answered() -> bool:
            alice.ask("swarm/r0/test/question", replies, timeout_s=0.2)
            return bool(replies)

        wait_until(answered)
        wait_until(lambda: tokens and tokens[-1][1], what="token")
        wait_until(lambda: changes and changes[-1], what="on_change")
        bus_service.kill()
        bus_service.wait()
        wait_until(lambda: not alice.connected and not bob.connected)
        wait_until(lambda: not tokens[-1][1], what="token gone")
        wait_until(lambda: not changes[-1], what="on_change")
        for _ in range(200):
            alice.publish("swarm/r0/test/lost", b"lost")
        samples.clear()
        replies.clear()
        bus_service = processes.router()
        wait_until(lambda: alice.connected and bob.connected, what=f"reconnect {round_}")
    talk(alice, "swarm/r0/test/x", samples)
    assert ("swarm/r0/test/lost", b"lost") not in samples


def test_on_change_tells_the_present_state_once(open_bus: Open, bus_service: subprocess.Popen[str]) -> None:
    bus = open_bus()
    assert bus.wait_connected(60)
    changes: list[bool] = []
    bus.on_change(changes.append)
    assert changes == [True]
    bus_service.kill()
    wait_until(lambda: changes == [True, False])


SUBSCRIBER = """
import sys
from swarm.bus.zenoh_bus import Bus
count = 0
def callback(key, payload):
    global count
    count += 1
with Bus(sys.argv[1]) as bus:
    bus.subscribe("swarm/**", callback)
    bus.wait_connected(None)
    print("listening", flush=True)
    sys.stdin.read()
"""


@pytest.mark.usefixtures("bus_service")
def test_a_stopped_subscriber_does_not_hold_up_the_others(open_bus: Open, processes: Processes, runtime: Path) -> None:
    stopped = processes.start("-c", SUBSCRIBER, bus_endpoint(runtime))
    assert stopped.stdout is not None
    assert stopped.stdout.readline() == "listening\n"
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    talk(alice, "swarm/r0/test/x", samples)
    stopped.send_signal(signal.SIGSTOP)
    block = bytes(4096)
    held_up = 0
    for number in range(1000):  # 4 MB: more than its socket and the router's queue for it hold
        started = time.monotonic()
        alice.publish("swarm/r0/test/y", block)
        held_up += time.monotonic() - started > HELD_UP
        assert held_up < 3
        if number % 100 == 0:
            talk(alice, "swarm/r0/test/x", samples, str(number).encode())
    talk(alice, "swarm/r0/test/x", samples, b"last")
    # Blocking congestion control holds a publisher for 5 s and more here, again and again.
    stopped.send_signal(signal.SIGCONT)
    _, errors = stopped.communicate(timeout=60)
    assert (stopped.returncode, errors) == (0, "")


def test_a_stopped_router_does_not_hold_up_a_publisher(open_bus: Open, bus_service: subprocess.Popen[str]) -> None:
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    talk(alice, "swarm/r0/test/x", samples)
    bus_service.send_signal(signal.SIGSTOP)
    held_up = 0
    for _ in range(300):
        started = time.monotonic()
        alice.publish("swarm/r0/test/y", bytes(60000))
        held_up += time.monotonic() - started > HELD_UP
        assert held_up < 3
    bus_service.send_signal(signal.SIGCONT)
    talk(alice, "swarm/r0/test/x", samples, b"again")


def test_a_bus_without_a_router_can_be_closed(runtime: Path) -> None:
    # It would wait without end for one: the suite's time-out tells.
    with Bus.of(runtime) as bus:
        bus.subscribe("swarm/**", lambda *_: None)
    bus.close()
    bus.publish("swarm/r0/test/x", b"after the end")
    bus.ask("swarm/r0/test/x", lambda *_: None)


def test_the_process_ends_while_no_router_is_there(processes: Processes, runtime: Path) -> None:
    code = "import sys; from swarm.bus.zenoh_bus import Bus; b = Bus(sys.argv[1]); b.announce('swarm/a/b/c'); b.close()"
    process = processes.start("-c", code, bus_endpoint(runtime))
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")


@pytest.mark.usefixtures("bus_service")
def test_a_failing_callback_is_logged_and_the_session_lives(open_bus: Open, caplog: pytest.LogCaptureFixture) -> None:
    alice, bob = open_bus(), open_bus()

    def fail(*_: object) -> bytes:
        raise ValueError("broken callback")

    samples = Samples()
    bob.subscribe("swarm/r0/test/bad", fail)
    bob.serve("swarm/r0/test/bad", fail)
    bob.subscribe("swarm/r0/test/good", samples)
    talk(alice, "swarm/r0/test/good", samples)
    alice.publish("swarm/r0/test/bad", b"")
    alice.ask("swarm/r0/test/bad", samples)
    wait_until(lambda: caplog.text.count("ValueError: broken callback") == 2)
    talk(alice, "swarm/r0/test/good", samples, b"still alive")


@pytest.mark.usefixtures("bus_service")
def test_a_callback_may_publish_ask_and_declare(open_bus: Open) -> None:
    alice, bob = open_bus(), open_bus()
    samples, later = Samples(), Samples()

    def callback(_: str, payload: bytes) -> None:
        bob.subscribe("swarm/r0/test/later", later)
        bob.ask("swarm/r0/test/question", lambda _, answer: bob.publish("swarm/r0/test/reply", answer + payload))

    alice.serve("swarm/r0/test/question", lambda *_: b"answer to ")
    alice.subscribe("swarm/r0/test/reply", samples)
    bob.subscribe("swarm/r0/test/start", callback)

    def replied() -> bool:
        alice.publish("swarm/r0/test/start", b"start")
        return ("swarm/r0/test/reply", b"answer to start") in samples

    wait_until(replied)
    talk(alice, "swarm/r0/test/later", later)


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


STOCK = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["' + sys.argv[1] + '"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("swarm/**/leds")
    sample = subscriber.recv()
    print(sample.key_expr, sample.encoding, flush=True)
"""


@pytest.mark.usefixtures("bus_service")
def test_stock_tools_reach_the_bus(open_bus: Open, processes: Processes, runtime: Path) -> None:
    """What Zenoh's own examples do for `-m client -e unixsock-stream/... --no-multicast-scouting`."""
    stock = processes.start("-c", STOCK, bus_endpoint(runtime))
    bus = open_bus()

    def ended() -> bool:
        bus.publish("swarm/r0/balancer/leds", Leds(1.0, True, False, True))
        return stock.poll() is not None

    wait_until(ended)
    assert stock.communicate() == ("swarm/r0/balancer/leds application/msgpack\n", "")


def test_a_client_of_the_bus_has_few_threads(
    processes: Processes, bus_service: subprocess.Popen[str], runtime: Path
) -> None:
    """The one-worker runtime is in force: without it a client has 7 threads, a router 8."""
    client = processes.start("-c", SUBSCRIBER, bus_endpoint(runtime))
    assert client.stdout is not None
    assert client.stdout.readline() == "listening\n"
    # One or two more than at rest for blocking calls of Zenoh's, which a busy machine makes it have at the same time.
    assert len(list(Path(f"/proc/{client.pid}/task").iterdir())) < 7
    assert len(list(Path(f"/proc/{bus_service.pid}/task").iterdir())) < 8


def test_importing_the_bus_pulls_in_nothing_heavy() -> None:
    code = "import sys, swarm.bus.zenoh_bus, swarm.process.service; print(*sys.modules)"
    loaded = subprocess.check_output([sys.executable, "-c", code], text=True).split()
    assert not {"numpy", "asyncio", "serial", "multiprocessing", "email", "http"} & set(loaded)


def test_direct_sessions_hear_each_other_through_a_routers_death_and_a_client_hears_each_message_once(
    processes: Processes, runtime: Path
) -> None:
    """Mesh and apps are such sessions. They find each other by the router, and one that comes anew does, too."""
    bus_service = processes.router()
    heard, watched, again = Samples(), Samples(), Samples()
    with Bus.of(runtime, "mesh") as mesh, Bus.of(runtime) as client:
        mesh.subscribe("swarm/r0/app/**", heard)
        client.subscribe("swarm/r0/app/**", watched)
        with Bus.of(runtime, "app/x") as app:
            talk(app, "swarm/r0/app/x/a", heard)
            talk(app, "swarm/r0/app/x/b", watched)
            for number in range(50):
                app.publish("swarm/r0/app/x/c", b"%d" % number)
            for samples in (heard, watched):
                wait_until(lambda: ("swarm/r0/app/x/c", b"49") in samples, what="the messages")  # noqa: B023
                told = [int(payload) for key, payload in samples if key.endswith("/c")]
                assert told == list(range(50))
            bus_service.kill()
            bus_service.wait()
            wait_until(lambda: not app.connected, what="the router's death")
            talk(app, "swarm/r0/app/x/d", heard)
            assert ("swarm/r0/app/x/d", b"hello") not in watched
            processes.router()
            wait_until(lambda: app.connected and mesh.connected and client.connected, what="the new router")
            talk(app, "swarm/r0/app/x/e", watched)
        with Bus.of(runtime, "app/x") as app:
            mesh.subscribe("swarm/r0/app/x/f", again)
            talk(app, "swarm/r0/app/x/f", again)
            assert app.connected


def test_a_direct_session_without_a_router_is_closed_at_once(runtime: Path) -> None:
    begin = time.monotonic()
    for _ in range(5):
        bus = Bus.of(runtime, "mesh")
        assert not bus.connected
        bus.close()
    assert time.monotonic() - begin < HELD_UP


def test_close_waits_for_a_session_that_is_still_being_opened_at_a_router(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread that comes back from Zenoh while the interpreter ends aborts the process."""
    answered = threading.Event()

    def slow(config: object) -> None:
        assert answered.wait(20.0)
        raise zenoh_bus.zenoh.ZError("the router has gone")

    monkeypatch.setattr(zenoh_bus.zenoh, "open", slow)
    (tmp_path / "bus.sock").touch()
    bus = Bus(f"{ENDPOINT_PROTOCOL}/{tmp_path / 'bus.sock'}")
    closing = threading.Thread(target=bus.close)
    closing.start()
    closing.join(1.0)
    assert closing.is_alive()
    answered.set()
    closing.join(20.0)
    assert not closing.is_alive()
    assert not bus._opener.is_alive()


def test_close_ends_at_once_where_no_router_has_come(tmp_path: Path) -> None:
    bus = Bus(f"{ENDPOINT_PROTOCOL}/{tmp_path / 'bus.sock'}")
    bus.close()
    assert not bus._opener.is_alive()
