"""The bus adapter against a real router process: messages, questions, tokens, callbacks and other subscribers."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bus_samples import HELD_UP, SUBSCRIBER, Open, Samples, talk
from conftest import Processes, wait_until

from swarm.messages import Leds, Stop, read
from swarm.messages.keys import MAX_KEY_LENGTH
from swarm.messages.service import MAX_STOP_TEXT
from swarm.process.paths import bus_endpoint

pytest_plugins = ("bus_fixtures",)


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
def test_a_sample_under_a_key_that_is_too_long_is_dropped(open_bus: Open) -> None:
    """As of a program that uses Zenoh without our adapter."""
    alice, bob = open_bus(), open_bus()
    samples = Samples()
    bob.subscribe("swarm/**", samples)
    talk(alice, "swarm/r0/test/x", samples)
    assert alice._session is not None
    alice._session.put("swarm/r0/" + "x" * MAX_KEY_LENGTH, b"long")
    alice._session.put("swarm/r0/test/y", b"short")
    wait_until(lambda: samples[-1] == ("swarm/r0/test/y", b"short"))
    assert max(len(key) for key, _ in samples) < MAX_KEY_LENGTH
    assert bob.counters["long_keys"] == 1


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
    talk(alice, "swarm/r0/test/x", on, b"later")
    assert ("swarm/r0/test/x", b"later") not in once


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

    def answered(more_than: int) -> bool:
        alice.ask("swarm/r0/dwm/measurement", replies, sequence=7)
        return len(replies) > more_than

    def heard() -> bool:
        alice.ask("swarm/r0/dwm/measurement", replies, sequence=8)
        return {"sequence": "8"} in asked

    wait_until(lambda: answered(0))
    wait_until(heard)
    before = len(replies)
    wait_until(lambda: answered(before))
    assert set(replies) == {("swarm/r0/dwm/measurement", b"row 7")}


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
