"""Real mesh processes with real bus routers, over sim: and tcp: links."""

import os
import re
import signal
import socket
import struct
from pathlib import Path

import pytest
from conftest import Processes, stop, wait_until
from mesh_rig import SHORT, SYNC, Build, Swarm, build, hello, log_of

from services.mesh.core.wire import frames
from sim.control.link_cuts import silence
from swarm.config.keyfile import new_key_file, read_keys, rotate
from swarm.messages import HoldLink
from swarm.messages.codec import MAX_BINARY, encode

__all__ = ["build"]


@pytest.mark.parametrize("kind", ["sim", "tcp"])
def test_messages_reach_neighbours_and_nobody_else(build: Build, kind: str) -> None:
    swarm = build(kind, (("r0", "r1"), ("r1", "r2")))
    swarm.start()
    swarm.talk("r0", "r1")
    swarm.talk("r1", "r2")
    swarm.talk("r2", "r1", payload=b"back")
    swarm.talk("r1", "r0", key=SYNC.format("r1") + "/r0", payload=b"only you")
    assert {key for key, _ in swarm["r2"].samples} == {SYNC.format("r1")}
    swarm["r0"].bus.publish("swarm/r0/app/consensus/state", b"not relayed")
    swarm["r0"].bus.publish("swarm/r1/app/consensus/sync/a", b"not r0's to say")
    sent = [str(number).encode() for number in range(300)]
    swarm["r1"].samples.clear()
    for payload in sent:
        swarm["r0"].bus.publish(SYNC.format("r0"), payload)
    # `talk` repeats itself, so others of its messages may still be under way.
    heard = swarm["r1"].samples
    wait_until(lambda: (SYNC.format("r0"), sent[-1]) in heard)
    assert [payload for key, payload in heard if key == SYNC.format("r0") and payload.isdigit()] == sent
    assert {key for key, _ in heard} <= {SYNC.format("r0"), SYNC.format("r2")}
    link = swarm["r0"].status()
    assert link.state == "ready"
    for robot in swarm.robots.values():
        assert robot.mesh is not None
        assert stop(robot.mesh) == 0


@pytest.mark.parametrize("victim", ["r0", "r1"])
def test_a_killed_mesh_is_met_again_at_once(build: Build, victim: str) -> None:
    swarm = build()
    swarm.start()
    robot, other = swarm[victim], swarm["r1" if victim == "r0" else "r0"]
    assert robot.mesh is not None
    robot.mesh.kill()
    wait_until(lambda: other.links[victim].state != "up", what="the neighbour sees it")
    robot.start()
    wait_until(lambda: other.links[victim].state == "up" and other.links[victim].connection == 2)
    swarm.talk("r0", "r1")
    swarm.talk("r1", "r0")


@pytest.mark.parametrize("victim", ["r0", "r1"])
def test_a_stopped_mesh_is_suspect_then_down_and_returns(build: Build, victim: str) -> None:
    swarm = build(times=SHORT)
    swarm.start()
    robot, other = swarm[victim], swarm["r1" if victim == "r0" else "r0"]
    assert robot.mesh is not None
    robot.mesh.send_signal(signal.SIGSTOP)
    wait_until(lambda: other.links[victim].state in ("down", "connecting"))
    assert (victim, "suspect") in other.seen
    robot.mesh.send_signal(signal.SIGCONT)
    swarm.wait_up()
    swarm.talk("r0", "r1")
    swarm.talk("r1", "r0")


def test_a_mesh_starts_before_the_bus_and_survives_its_restart(build: Build) -> None:
    # A bus of its own process, as on a robot: see Router.close.
    swarm = build(own_bus=("r0",))
    robot = swarm["r0"]
    for each in swarm.robots.values():
        each.start()
    for _ in range(2):
        bus = swarm.processes.router(SWARM_RUNTIME=str(robot.directory))
        swarm.wait_up()
        swarm.talk("r0", "r1")
        swarm.talk("r1", "r0")
        assert stop(bus) == 0
        robot.links.clear()


def test_a_cut_link_returns(build: Build) -> None:
    swarm = build(model="latency=0.005", times=SHORT)
    swarm.start()

    def cut(seconds: float) -> None:
        for robot, peer in (("r0", "r1"), ("r1", "r0")):
            silence(swarm.runtime, robot, peer, seconds)

    cut(60.0)
    wait_until(lambda: swarm["r0"].links["r1"].state in ("down", "connecting"))
    assert ("r1", "suspect") in swarm["r0"].seen
    wait_until(lambda: swarm["r0"].links["r1"].reason == "unreachable")
    cut(0.0)
    swarm.wait_up()
    assert swarm["r0"].links["r1"].connection == 2
    swarm.talk("r0", "r1")


def test_a_link_is_held_down_on_command_and_let_up(build: Build) -> None:
    swarm = build(times=SHORT)
    swarm.start()
    wish = "swarm/r1/mesh/set/hold"
    for wrong in (b"no message", encode(HoldLink("r9", 60.0))):
        swarm["r1"].bus.publish(wish, wrong, urgent=True)
    swarm["r1"].bus.publish(wish, HoldLink("r0", 60.0), urgent=True)
    for robot, peer in (("r0", "r1"), ("r1", "r0")):
        wait_until(lambda robot=robot, peer=peer: "held down on command" in swarm[robot].links[peer].reason)
    swarm["r1"].bus.publish(wish, HoldLink("r0", 0.0), urgent=True)
    swarm.wait_up()
    swarm.talk("r0", "r1")


def strangers(swarm: Swarm, kind: str, data: bytes) -> socket.socket:
    """Connect to r1 and write, as a program that is no mesh of ours."""
    if kind == "tcp":
        sock = socket.create_connection(("127.0.0.1", swarm.ports["r1"]))
    else:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        sock.connect(os.fspath(swarm["r1"].directory / "mesh.sock"))
        data = b"\x02r0" + struct.pack("<Id", len(data), 0.0) + data
    sock.sendall(data)
    sock.settimeout(60)
    return sock


@pytest.mark.parametrize("kind", ["sim", "tcp"])
def test_strangers_are_refused_counted_and_logged_once(build: Build, kind: str) -> None:
    swarm = build(kind)
    swarm.start()
    wrong = {
        "refused_version": hello(versions=(4, 9)),
        "refused_network": hello(network="other"),
        "refused_robot": hello(robot="r7"),
        "bad_frames": b"GET / HTTP/1.1\r\n\r\n",
    }
    for data in wrong.values():
        for _ in range(3):
            with strangers(swarm, kind, data) as sock:
                received = b""
                while more := sock.recv(4096):
                    received += more
                assert frames.MAGIC in received
                assert b"\x02\x00\x03" in received, "BYE says why"
    counters = swarm["r1"].status().counters
    assert {name: counters[name] for name in wrong} == dict.fromkeys(wrong, 3)
    swarm.talk("r0", "r1")
    assert swarm["r1"].links["r0"].connection == 1
    assert swarm["r1"].mesh is not None
    log = log_of(swarm["r1"].mesh)
    assert log.count("speaks protocol versions 4 to 9, we speak 3") == 1
    assert log.count("connection refused") == len(wrong)
    assert "Traceback" not in log


def test_a_full_link_lets_urgent_messages_pass_and_pushes_bulk_back(build: Build) -> None:
    rule = '[[relay]]\nkeys = "swarm/{self}/app/bulk/*"\nqueue = "all"\n'
    swarm = build(extra=rule, model="latency=0.001,bandwidth=40000")
    swarm.start()
    swarm.talk("r0", "r1")
    sender, receiver = swarm["r0"], swarm["r1"]
    published = 0

    def is_full() -> bool:
        nonlocal published
        for _ in range(20):
            published += 1
            sender.bus.publish("swarm/r0/app/bulk/x", struct.pack("<I", published) + bytes(20_000))
        return "pushed_back" in sender.status().counters

    wait_until(is_full)
    sender.bus.publish(SYNC.format("r0"), b"urgent")
    wait_until(lambda: (SYNC.format("r0"), b"urgent") in receiver.samples)
    place = receiver.samples.index((SYNC.format("r0"), b"urgent"))
    wait_until(lambda: len(receiver.samples) > place + 1, what="bulk that was published before it")
    numbers = [struct.unpack_from("<I", payload)[0] for key, payload in receiver.samples if "bulk" in key]
    assert numbers == sorted(set(numbers))
    assert len(numbers) < published


def test_the_largest_message_crosses_buses_and_mesh(build: Build) -> None:
    rule = '[[relay]]\nkeys = "swarm/{self}/app/bulk/*"\nqueue = "all"\n'
    swarm = build(extra=rule, model="latency=0.001,bandwidth=2000000")
    swarm.start()
    swarm.talk("r0", "r1", key="swarm/r0/app/bulk/x", payload=os.urandom(MAX_BINARY))


@pytest.mark.parametrize("kind", ["sim", "tcp"])
def test_a_second_mesh_of_a_robot_says_so_and_ends(build: Build, kind: str) -> None:
    swarm = build(kind)
    swarm.start()
    robot = swarm["r1"]
    second = swarm.processes.start(
        "-m",
        "services.mesh",
        SWARM_ROBOT="r1",
        SWARM_RUNTIME=str(robot.directory),
        SWARM_CONFIG=str(robot.config),
    )
    _, log = second.communicate(timeout=60)
    assert second.returncode == 2
    expected = "another mesh of this robot runs already" if kind == "sim" else "address already in use"
    assert expected in log
    assert "Traceback" not in log
    swarm.talk("r0", "r1")


def test_a_robot_that_is_called_over_tcp_must_listen(processes: Processes, runtime: Path) -> None:
    Path(processes.config).write_text(
        'network = "test"\n[topology]\nshape = "line"\n[mesh]\ninsecure = true\n'
        '[[robots]]\nname = "r0"\nlink = "tcp:127.0.0.1:7447"\n'
        '[[robots]]\nname = "r1"\nlink = "tcp:127.0.0.1:7448"\n'
    )
    process = processes.start("-m", "services.mesh", SWARM_ROBOT="r1")
    _, log = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "[mesh] listen: r0 will dial r1 over tcp:" in log
    assert '"0.0.0.0:7448"' in log


def test_a_robot_alone_needs_no_link(processes: Processes) -> None:
    processes.config.write_text('network = "test"\n[[robots]]\nname = "r0"\n')
    process = processes.start_ready("-m", "services.mesh")
    assert stop(process) == 0


@pytest.mark.parametrize("kind", ["sim", "tcp"])
def test_robots_with_the_key_meet_and_nobody_else(build: Build, runtime: Path, kind: str) -> None:
    """r2 has another key of the same swarm's past; strangers have none."""
    key, wrong = runtime / "key", runtime / "wrong"
    new_key_file(key, 1000.0)
    new_key_file(wrong, 1000.0)
    swarm = build(kind, (("r0", "r1"), ("r1", "r2")), key=key)
    third = swarm["r2"]
    third.config.write_text(third.config.read_text().replace(str(key), str(wrong)))
    for robot in swarm.robots.values():
        robot.start()
    wait_until(lambda: swarm["r1"].links.get("r0") and swarm["r1"].links["r0"].state == "up")
    swarm.talk("r0", "r1")
    swarm.talk("r1", "r0")
    for data in (hello(), hello(insecure=False, key_ids=(1000,))):
        with strangers(swarm, kind, data + frames.encode_confirm(bytes(32))) as sock:
            while sock.recv(4096):
                pass
    reason = re.compile("another key|does not hold the key")
    wait_until(lambda: swarm["r1"].links.get("r2") and reason.search(swarm["r1"].links["r2"].reason))
    counters = swarm["r1"].status().counters
    assert counters["refused_security"] == 1
    assert counters["refused_key"] >= 1
    assert swarm["r1"].links["r2"].connection == 0
    assert swarm["r1"].links["r0"].connection == 1
    # The right key, as the first half of a rotation brings it, lets r2 in beside the others.
    assert third.mesh is not None
    assert stop(third.mesh) == 0
    rotate(key, 2000.0)
    third.config.write_text(third.config.read_text().replace(str(wrong), str(key)))
    third.start()
    swarm.wait_up()
    swarm.talk("r1", "r2")
    swarm.talk("r2", "r1")
    mesh = swarm["r1"].mesh
    assert mesh is not None
    log = log_of(mesh)
    assert "Traceback" not in log
    assert log.count("we are not") == 1
    assert not [secret for secret in read_keys(key).values() if secret.hex() in log]


@pytest.mark.parametrize(
    ("bits", "problem"),
    [
        (None, "there is no such file, and without a key no link comes up. Make one by `swarm key new"),
        (0o640, "chmod 600"),
    ],
)
def test_a_mesh_without_a_proper_key_says_so_and_ends(
    processes: Processes, runtime: Path, bits: int | None, problem: str
) -> None:
    key = runtime / "key"
    if bits is not None:
        new_key_file(key, 1000.0)
        key.chmod(bits)
    text = processes.config.read_text()
    processes.config.write_text(text.replace("insecure = true", f'key = "{key}"'))
    process = processes.start("-m", "services.mesh", SWARM_ROBOT="r1")
    _, log = process.communicate(timeout=60)
    assert process.returncode == 2
    assert f"{key}: " in log
    assert problem in log
    assert "Traceback" not in log
