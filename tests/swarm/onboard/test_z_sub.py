"""z_sub as a user runs it, against real buses; and that every payload whatsoever can be shown."""

import json
import select
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
from conftest import Processes, wait_until
from hypothesis import given
from hypothesis import strategies as st

from swarm.bus.zenoh_bus import Bus
from swarm.messages import Leds
from swarm.onboard.buses.samples import BusSample, as_json, as_text, value_text
from swarm.process.paths import bus_endpoint
from swarm.process.simulations import claim

Z_SUB = ("-m", "laptop.cli.z_sub")
RED = Leds(1.0, red=True, yellow=False, green=False)


@pytest.fixture
def bus(runtime: Path) -> Iterator[Bus]:
    with Bus.of(runtime) as bus:
        yield bus


def lines_while_publishing(process: subprocess.Popen[str], bus: Bus, key: str, message: object) -> list[str]:
    """What a z_sub that ends by itself prints, while `key` is published all the time."""

    def ended() -> bool:
        bus.publish(key, message)
        return process.poll() is not None

    wait_until(ended)
    output, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    return output.splitlines()


def refused(processes: Processes, *arguments: str, **environment: str) -> str:
    process = processes.start(*Z_SUB, *arguments, **environment)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output) == (2, "")
    assert "Traceback" not in errors
    return errors


@pytest.mark.usefixtures("router")
def test_a_line_for_each_sample(processes: Processes, bus: Bus) -> None:
    process = processes.start(*Z_SUB, "swarm/*/balancer/**", "-k", "swarm/x/**", "--count", "3")
    lines = lines_while_publishing(process, bus, "swarm/r0/balancer/leds", RED)
    assert len(lines) == 3
    time, key, *fields = lines[0].split()
    assert len(time) == len("12:34:56.789")
    assert (key, fields) == ("swarm/r0/balancer/leds", ["t=1", "red=true", "yellow=false", "green=false"])


@pytest.mark.usefixtures("router")
def test_z_sub_prints_a_json_object_for_each_sample(processes: Processes, bus: Bus) -> None:
    process = processes.start(*Z_SUB, "swarm/r0/balancer/leds", "--json", "--count", "2")
    for line in lines_while_publishing(process, bus, "swarm/r0/balancer/leds", RED):
        data = json.loads(line)
        assert data["value"] == {"t": 1.0, "red": True, "yellow": False, "green": False}
        assert data["key"] == "swarm/r0/balancer/leds"


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize("form", [(), ("--json",)])
def test_z_sub_prints_samples_and_bytes_a_second(processes: Processes, bus: Bus, form: tuple[str, ...]) -> None:
    process = processes.start(*Z_SUB, "swarm/r0/balancer/**", "--rate", *form)
    wait_for_line(process, bus)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    lines = output.splitlines()
    assert lines
    if form:
        assert json.loads(lines[0])["rate"] > 0
    else:
        assert all("swarm/r0/balancer/leds" in line and "/s " in line for line in lines)


@pytest.mark.usefixtures("router")
def test_z_sub_ends_after_the_seconds_given(processes: Processes, bus: Bus) -> None:
    lines_while_publishing(processes.start(*Z_SUB, "--seconds", "0.1"), bus, "swarm/r0/balancer/leds", RED)


@pytest.mark.usefixtures("router")
def test_bad_samples_do_not_end_it(processes: Processes, bus: Bus) -> None:
    process = processes.start(*Z_SUB, "--count", "400")
    payloads = [b"", b"\xc1", b"hello", b"\xff" * 300, b"\x91" * 900 + b"\x90", msgpack.packb({"red": 3})]
    sent = 0

    def ended() -> bool:
        nonlocal sent
        for key in ("swarm/r0/balancer/leds", "swarm/r0/app/a/sync/1-0-0-1", "swarm/\x1b[2J/ü"):
            bus.publish(key, payloads[sent % len(payloads)])
        sent += 1
        return process.poll() is not None

    wait_until(ended)
    output, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    assert "\x1b" not in output
    assert "2 bytes" not in output
    assert "5 bytes 0x68656c6c6f (payload is not msgpack" in output
    assert "red=3 (! green: missing)" in output


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_is_a_clean_end(processes: Processes, bus: Bus, number: signal.Signals) -> None:
    process = processes.start(*Z_SUB)
    wait_for_line(process, bus)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0 if number == signal.SIGINT else -number, "")


def wait_for_line(process: subprocess.Popen[str], bus: Bus) -> None:
    """Publish until z_sub prints: then it is subscribed."""
    assert process.stdout is not None

    def readable() -> bool:
        bus.publish("swarm/r0/balancer/leds", RED)
        return bool(select.select([process.stdout], [], [], 0.01)[0])

    wait_until(readable)


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize("more_samples", [True, False])
def test_a_closed_pipe_is_a_clean_end(processes: Processes, bus: Bus, *, more_samples: bool) -> None:
    process = processes.start(*Z_SUB)
    assert process.stdout is not None
    wait_for_line(process, bus)
    process.stdout.close()

    def ended() -> bool:
        if more_samples:
            bus.publish("swarm/r0/balancer/leds", RED)
        return process.poll() is not None

    wait_until(ended)
    assert process.stderr is not None
    assert (process.returncode, process.stderr.read()) == (0, "")


def test_z_sub_waits_for_the_bus_and_says_so(processes: Processes, runtime: Path, bus: Bus) -> None:
    process = processes.start(*Z_SUB, "swarm/r0/balancer/leds", "--count", "1")
    assert process.stderr is not None
    assert process.stderr.readline() == f"z_sub: {bus_endpoint(runtime)} is not there, waiting for it\n"
    processes.router()

    def ended() -> bool:
        bus.publish("swarm/r0/balancer/leds", RED)
        return process.poll() is not None

    wait_until(ended)
    assert process.returncode == 0


def test_z_sub_listens_to_a_named_endpoint(processes: Processes, runtime: Path, bus: Bus) -> None:
    processes.router()
    process = processes.start(*Z_SUB, "-e", bus_endpoint(runtime), "--count", "1", SWARM_RUNTIME="/nowhere")
    assert len(lines_while_publishing(process, bus, "swarm/r0/balancer/leds", RED)) == 1


def test_all_robots_of_a_simulation(processes: Processes, runtime: Path) -> None:
    run_dir = runtime / "swarm-sim"  # the default one: XDG_RUNTIME_DIR is `runtime`
    with claim(run_dir):
        for robot in ("r0", "r1"):
            (run_dir / robot).mkdir()
            processes.router(SWARM_RUNTIME=str(run_dir / robot), SWARM_ROBOT=robot)
        (run_dir / "swarm.toml").write_text(processes.config.read_text())
        with Bus.of(run_dir / "r0") as bus0, Bus.of(run_dir / "r1") as bus1:
            several = processes.start(*Z_SUB, "swarm/*/balancer/*", "--json", SWARM_RUNTIME="")
            one = processes.start(*Z_SUB, "swarm/*/balancer/*", "--robots", "r1", "--count", "5", SWARM_RUNTIME="")
            seen: set[str] = set()
            assert several.stdout is not None
            while seen != {"r0", "r1"}:
                for bus in (bus0, bus1):
                    bus.publish("swarm/r9/balancer/leds", RED)
                while select.select([several.stdout], [], [], 0.01)[0]:
                    seen.add(json.loads(several.stdout.readline())["robot"])

            def ended() -> bool:
                for bus in (bus0, bus1):
                    bus.publish("swarm/r9/balancer/leds", RED)
                return one.poll() is not None

            wait_until(ended)
            assert all("[r1] swarm/r9/balancer/leds" in line for line in one.communicate()[0].splitlines())
        assert "no robot 'r7' in the simulation, there are r0, r1" in refused(
            processes, "--robots", "r7", SWARM_RUNTIME=""
        )
    _, errors = several.communicate(timeout=60)
    assert several.returncode == 0
    assert "the simulation has ended" in errors


def test_z_sub_refuses_wrong_arguments_by_name(processes: Processes, runtime: Path) -> None:
    no_robot = "no simulation is running here (looked in "
    assert no_robot in refused(processes, SWARM_RUNTIME="") or Path("/run/swarm").is_dir()
    assert f"no simulation is running in {runtime}/x" in refused(processes, "--run-dir", f"{runtime}/x")
    assert "r99 is no robot of" in refused(processes, "--robots", "r99")  # it would be reached by ssh
    assert "expected unixsock-stream/PATH" in refused(processes, "-e", "tcp/localhost:7447")
    assert "key 'swarm//x'" in refused(processes, "swarm//x")
    assert "use one of them" in refused(processes, "-e", "unixsock-stream//x", "--robots", "r0")
    assert "expected 1 or more" in refused(processes, "--count", "0")
    assert "expected a number above 0 s" in refused(processes, "--seconds", "nan")
    assert "at most 107" in refused(processes, SWARM_RUNTIME="/tmp/" + "x" * 110)


def test_the_installed_command_has_a_help() -> None:
    command = Path(sys.executable).parent / "z_sub"
    output = subprocess.check_output([command, "--help"], text=True)
    assert "key expressions, default swarm/**" in output
    assert len(output.splitlines()) <= 24


def show(key: str, payload: bytes) -> str:
    return as_text(BusSample(0.25, "", key, payload)).split(maxsplit=1)[1]


def test_z_sub_shows_frames_of_apps() -> None:
    key = "swarm/r0/app/consensus/sync/00000000000000a1-0-3-9f3c21aa"
    step = b"\x01\x07\x00\x00\x00" + bytes(16)
    assert show(key, step) == f"{key} STEP k=7 21 bytes 0x{step.hex()}"
    assert show(key + "/r1", b"\x02\x07\x00\x00\x00") == f"{key}/r1 WANT k=7"
    assert show(key, b"\x09\x07\x00\x00\x00") == f"{key} kind 9 k=7 5 bytes 0x0907000000"
    latest = key.replace("sync", "latest")
    assert show(latest, b"\x01\x07\x00\x00\x00\xff") == f"{latest} STATE sequence=7 6 bytes 0x0107000000ff"
    data = json.loads(as_json(BusSample(0.25, "r0", key, step)))
    assert "state" not in data
    assert (data["frame"], data["k"], data["bytes"], data["hex"]) == ("STEP", 7, 21, step.hex())


def test_frames_of_apps_that_tell_how_their_states_lie() -> None:
    key = "swarm/r0/app/mine/sync/00000000000000a1-0-3-9f3c21aa"
    layouts = {"": "value=d x=2f on=?", "pace": "value=f"}
    state = struct.pack("<d2f?", 2.5, 0.5, -1.0, True)

    def shown(name: str, payload: bytes) -> str:
        return as_text(BusSample(0.25, "", name, payload, layouts)).split(maxsplit=1)[1]

    head = b"\x01\x07\x00\x00\x00"
    assert shown(key, head + state + bytes(17)) == f"{key} STEP k=7 value=2.5 x=[0.5 -1] on=true"
    assert shown(key, head + struct.pack("<2f", 2.0, 1.0)) == f"{key} STEP k=7 value=2"
    assert shown(key, b"\x01\x00\x00\x00\x00" + state) == f"{key} STEP k=0 value=2.5 x=[0.5 -1] on=true"
    assert shown(key, b"\x02\x07\x00\x00\x00") == f"{key} WANT k=7"
    latest = key.replace("sync", "latest")
    assert shown(latest, b"\x00\x07\x00\x00\x00" + state + b"\x03") == (
        f"{latest} STATE sequence=7 value=2.5 x=[0.5 -1] on=true"
    )
    assert "0x01" in shown(key, head + state)  # neither of the lengths
    data = json.loads(as_json(BusSample(0.25, "r0", key, head + state + bytes(17), layouts)))
    assert data["state"] == {"value": 2.5, "x": [0.5, -1.0], "on": True}


@given(st.dictionaries(st.text(max_size=4), st.text("dfqx=? 0123456789", max_size=20), max_size=3), st.binary())
def test_no_layout_that_a_process_tells_breaks_it(layouts: dict[str, str], body: bytes) -> None:
    key = "swarm/r0/app/mine/sync/00000000000000a1-0-3-9f3c21aa"
    as_text(BusSample(0.25, "", key, b"\x01\x07\x00\x00\x00" + body, layouts))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"t": 12.3456, "x": None, "on": True}, "t=12.35 x=- on=true"),
        ({"t": 86400.12345, "small": 1.5e-7}, "t=86400.123 small=1.5e-07"),
        ({"links": [{"peer": "r1", "rtt": 0.06}]}, "links=[{peer=r1 rtt=0.06}]"),
        ({"reason": "no route", "esc": "\x1b[2J\x7f"}, 'reason="no route" esc="\\u001b[2J\\u007f"'),
        ({}, "{}"),
        ([1, 2.5, b"\x01\xff"], "[1 2.5 2 bytes 0x01ff]"),
        (float("nan"), "nan"),
        ("", '""'),
    ],
)
def test_z_sub_shows_values_in_short(value: object, text: str) -> None:
    assert value_text(value) == text


KEY = st.text(max_size=20) | st.sampled_from(
    ["swarm/r0/app/a/sync/x", "swarm/r0/balancer/leds", "swarm/stop", "swarm/r0/mesh/links"]
)
NESTED = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-(2**63), 2**64 - 1) | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
).map(msgpack.packb)


@given(KEY, st.binary() | NESTED | st.integers(1, 3000).map(lambda depth: b"\x91" * depth + b"\x90"))
def test_every_payload_can_be_shown(key: str, payload: bytes) -> None:
    sample = BusSample(1.0, "r0", key, payload)
    line = as_text(sample)
    assert line.isprintable()
    data = json.loads(as_json(sample), parse_constant=pytest.fail)
    assert data["key"] == key
