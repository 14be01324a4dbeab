"""The real processes: body, bridge, router. How they start, what they say, how they end."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import msgpack
import pytest
from conftest import Processes, stop, wait_until
from process_rig import Watcher, watcher

from bench.rigs.running import running
from swarm.messages import (
    AppState,
    ImuRequest,
    MeasureI2C,
    ModuleRequest,
    Note,
    SetDisplay,
    SetLeds,
    SetMode,
    SetNotes,
    SetParameters,
    SetVelocity,
    Stop,
    read,
)
from swarm.process.edges import DEFECT

__all__ = ["watcher"]

RECORDING = str(Path(__file__).with_name("recording_body.py"))


def children(pid: int) -> list[int]:
    return [int(text) for text in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


def test_a_robot_stands_talks_obeys_and_stops(processes: Processes, watcher: Watcher, runtime: Path) -> None:
    body = processes.start_ready("-m", "sim.body")
    state = watcher.wait_balancing()
    assert abs(state.tilt) < 0.2
    wait_until(lambda: watcher.lamps() == (False, False, True))

    # 25 Hz: telemetry counts ticks of 10 ms, so its number is known without a clock. A busy machine loses some of it.
    first = len(watcher.heard["state"]) - 1
    wait_until(lambda: len(watcher.heard["state"]) > first + 25)
    steps = [b.ticks - a.ticks for a, b in pairwise(watcher.heard["state"][first:])]
    assert all(step > 0 and step % 4 == 0 for step in steps)
    sequences = [odometry.sequence for odometry in watcher.heard["odometry"]]
    assert all(a < b for a, b in pairwise(sequences))
    wait_until(lambda: watcher.last("status") is not None and watcher.last("status").state == "ready")

    watcher.command("leds", SetLeds(True, True, False))
    wait_until(lambda: watcher.lamps() == (True, True, False))

    watcher.command("mode", SetMode("dance"))
    watcher.command("mode", b"\xc1")
    watcher.command("leds", {"red": 1})
    watcher.command("mode", SetMode("rest"))
    watcher.wait_mode("idle")
    # The mode changes at once, the motors at the next tick: a message from between shows the last duties.
    wait_until(lambda: (watcher.last("state").duty_left, watcher.last("state").duty_right) == (0.0, 0.0))

    replies: list[bytes] = []
    wait_until(
        lambda: replies or watcher.bus.ask("swarm/r0/balancer/status", lambda _, payload: replies.append(payload))
    )
    assert read("swarm/r0/balancer/status", replies[0]).counters == {"refused": 3}
    watcher.command("velocity", SetVelocity(0.1, 0.0, 1.0))
    refused = "refused: velocity: only a balancing robot drives, this one is idle"
    wait_until(lambda: watcher.heard["notice"] and watcher.last("notice").text == refused)

    watcher.command("mode", SetMode("stand"))
    watcher.wait_balancing()
    watcher.bus.publish("swarm/stop", Stop(0.0, "test", "enough"))
    state = watcher.wait_mode("fault")
    assert state.fault == "stopped: enough (by test)"
    wait_until(lambda: watcher.last("status").state == "degraded")
    assert watcher.last("status").reason == state.fault

    bridge = children(body.pid)
    assert stop(body) == 0
    wait_until(lambda: not any(map(alive, bridge)))
    wait_until(lambda: watcher.last("status").state == "stopping")


def test_the_loop_outlives_its_bridge_and_starts_another(processes: Processes, watcher: Watcher) -> None:
    body = processes.start("-m", "sim.body")
    watcher.wait_balancing()
    (bridge,) = children(body.pid)
    os.kill(bridge, signal.SIGKILL)
    before = [*watcher.heard["state"]]
    wait_until(lambda: children(body.pid) not in ([], [bridge]))
    count = len(watcher.heard["state"])
    wait_until(lambda: len(watcher.heard["state"]) > count + 5)
    watcher.assert_balancing()

    def lost() -> float:
        """Ticks that are neither done nor missed by the loop's own time. A tick that begins late has that in its time
        and not yet in what was missed, so states are compared until two agree."""
        after = watcher.last()
        return min(
            abs((after.t - one.t) * 100 - (after.ticks + after.missed - one.ticks - one.missed)) for one in before
        )

    wait_until(lambda: lost() <= 2.0, what="it has ticked on while nobody listened")


def test_a_stop_holds_though_the_bridge_that_heard_it_is_killed(processes: Processes, watcher: Watcher) -> None:
    """No mesh runs here, which could tell the next bridge."""
    body = processes.start("-m", "sim.body")
    watcher.wait_balancing()
    watcher.bus.publish("swarm/stop", Stop(0.0, "test", "enough"))
    watcher.wait_mode("fault")
    (bridge,) = children(body.pid)
    os.kill(bridge, signal.SIGKILL)
    wait_until(lambda: children(body.pid) not in ([], [bridge]))
    watcher.heard["notice"].clear()

    def refused() -> bool:
        watcher.command("mode", SetMode("stand"))
        return any("the swarm is stopped" in notice.text for notice in watcher.heard["notice"])

    wait_until(refused, what="the new bridge refuses to let the robot stand up")
    assert watcher.last().mode == "fault"


def test_driving_over_the_bus_and_what_is_refused(processes: Processes, watcher: Watcher) -> None:
    processes.start("-m", "sim.body")
    watcher.wait_balancing()

    start = watcher.last("odometry").x
    watcher.command("velocity", SetVelocity(0.2, 0.0, 5.0))
    wait_until(lambda: watcher.last().demanded_speed == 0.2, what="it drives")
    wait_until(lambda: watcher.last("odometry").x > start + 0.3, what="it has gone somewhere")
    (bridge,) = [pid for pid in children(watcher.body_pid(processes)) if alive(pid)]
    os.kill(bridge, signal.SIGKILL)
    # Who commanded is gone with it: the speed runs out, and the robot stands.
    count = len(watcher.heard["state"])
    wait_until(lambda: len(watcher.heard["state"]) > count + 2 and watcher.last().demanded_speed == 0.0)
    watcher.assert_balancing()

    watcher.heard["notice"].clear()
    for what, payload, word in (
        ("velocity", {"speed": float("nan"), "turn_rate": 0.0, "seconds": 1.0}, "finite"),
        ("velocity", SetVelocity(0.1, 0.0, 1e9), "seconds"),
        ("velocity", SetVelocity(3.0, 0.0, 0.1), "above the limit"),
        ("mode", SetMode("dance"), "expected one of"),
        ("mode", SetMode("calibrate"), "must be idle"),
        ("parameters", SetParameters({"gain": 1.0}), "unknown"),
    ):
        watcher.command(what, payload if not isinstance(payload, dict) else msgpack.packb(payload))
        wait_until(lambda: watcher.heard["notice"], what=f"a notice about {payload}")
        notice = watcher.heard["notice"].pop()
        assert notice.about == what
        assert word in notice.text
    watcher.assert_balancing()


def test_a_robot_has_the_controller_and_body_that_the_file_gives_it(processes: Processes, watcher: Watcher) -> None:
    with processes.config.open("a") as file:
        file.write('[balancing.robots.r0]\ncontroller = "pololu"\nmax_speed = 0.3\n[body.robots.r0]\ntrim = 0.19\n')
    processes.start("-m", "sim.body")
    state = watcher.wait_balancing()
    assert state.posture == "upright", "with its trim taken out"
    wait_until(lambda: watcher.last("parameters") is not None, what="the parameters")
    told = watcher.last("parameters")
    assert (told.controller, told.parameters["trim"], told.parameters["max_speed"]) == ("pololu", 0.19, 0.3)
    assert told.parameters["angle_response"] == 11.0


def test_the_loop_needs_no_bus(processes: Processes, runtime: Path) -> None:
    """No router anywhere: it balances, and READY comes from the loop."""
    robot = runtime / "r0"
    robot.mkdir()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as world:
        world.bind(str(runtime / "world.sock"))
        world.settimeout(60)
        body = processes.start_ready("-m", "sim.body", SWARM_RUNTIME=str(robot), SWARM_SEED="3")
        # A world that does not answer costs it half a second, no more.
        assert msgpack.unpackb(world.recv(4096)) == {"robot": "r0"}
        report = msgpack.unpackb(world.recv(4096))
        assert report.keys() == {"robot", "t", "x", "y", "heading", "tilt", "held", "speed"}
        assert report["robot"] == "r0"
    (bridge,) = children(body.pid)
    assert stop(body) == 0
    wait_until(lambda: not alive(bridge))


def test_the_bridge_dies_with_the_loop(processes: Processes, watcher: Watcher) -> None:
    body = processes.start("-m", "sim.body")
    wait_until(watcher.last, what="the bridge works")
    (bridge,) = children(body.pid)
    body.kill()
    wait_until(lambda: not alive(bridge))


def test_the_bridge_ends_when_the_loop_lets_go(processes: Processes, router: object) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    our_stops, their_stops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs, our_stops, their_stops:
        descriptors = [theirs.fileno(), their_stops.fileno()]
        command = [sys.executable, "-m", "services.balancer.bridge.bridge", *descriptors]
        environment = processes.environment()
        with running(command, env=environment, pass_fds=descriptors, stderr=subprocess.DEVNULL) as bridge:
            for each in (theirs, ours, their_stops, our_stops):
                each.close()
            assert bridge.wait(60) == 0


DEAF = """
import threading
from services.balancer.bridge import bridge
from services.balancer.bridge.bus_side import BusSide
from swarm.bus import session_watch
from swarm.process.edges import run

def hang(*_):
    session_watch.ASK_S = 0.05
    threading.Event().wait()

BusSide._stop = hang
run(bridge.main)
"""
"""A bridge that a stop makes deaf: Zenoh's thread hangs in its callback. From then on it asks the router often."""


def test_a_bridge_whose_bus_thread_hangs_ends(processes: Processes, watcher: Watcher) -> None:
    """So that the loop starts another one, which hears stops. Until then it does its work."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    our_stops, their_stops = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs, our_stops, their_stops:
        descriptors = [theirs.fileno(), their_stops.fileno()]
        command = [sys.executable, "-c", DEAF, *descriptors]
        with running(
            command, env=processes.environment(), pass_fds=descriptors, stderr=subprocess.PIPE, text=True
        ) as bridge:
            wait_until(lambda: watcher.heard["status"], what="the bridge")

            def ended() -> bool:
                watcher.bus.publish("swarm/stop", Stop(0.0, "test", "hang"))
                return bridge.poll() is not None

            wait_until(ended, what="the end of the deaf bridge")
            assert bridge.returncode == DEFECT
            assert "5 questions to the router were not answered" in bridge.stderr.read()


@pytest.mark.slow
def test_a_robot_stands_through_a_router_that_hangs_and_obeys_a_stop_afterwards(
    processes: Processes, bus_service: subprocess.Popen[str], runtime: Path
) -> None:
    watcher = Watcher(runtime)
    body = processes.start("-m", "sim.body")
    before = watcher.wait_balancing()
    (bridge,) = children(body.pid)
    bus_service.send_signal(signal.SIGSTOP)
    wait_until(lambda: children(body.pid) not in ([], [bridge]), what="another bridge")
    bus_service.send_signal(signal.SIGCONT)
    wait_until(lambda: watcher.last().ticks > before.ticks + 100, what="the new bridge")
    watcher.assert_balancing()

    def stopped() -> bool:
        watcher.bus.publish("swarm/stop", Stop(0.0, "test", "enough"))
        return watcher.last().mode == "fault"

    wait_until(stopped, what="a stop")
    watcher.bus.close()


def test_the_bridge_is_not_for_hands(processes: Processes) -> None:
    _, error = processes.start("-m", "services.balancer.bridge.bridge").communicate(timeout=60)
    assert error == "bridge.py: the bridge is started by `python -m services.balancer`, not by hand\n"


def test_a_real_robot_without_i2c_says_so(processes: Processes) -> None:
    impatient = (
        "import runpy; from services.balancer import i2c; i2c.PATIENCE_S = i2c.RETRY_S;"
        "runpy.run_module('services.balancer', run_name='__main__')"
    )
    process = processes.start("-c", impatient)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "i2c" in error.lower() or "I2C" in error
    assert "Traceback" not in error


class Recorded:
    """The robot of recording_body.py and what its motors were told."""

    def __init__(self, processes: Processes, runtime: Path) -> None:
        self.record = runtime / "motors"
        self.process = processes.start(RECORDING, str(self.record), PYTHONPATH=str(Path.cwd()))
        wait_until(lambda: any(line not in ("0.0", "-0.0") for line in self.lines()), what="motors")

    def lines(self) -> list[str]:
        return self.record.read_text().splitlines() if self.record.exists() else []


def test_the_last_command_is_motors_off(processes: Processes, runtime: Path) -> None:
    robot = Recorded(processes, runtime)
    assert stop(robot.process) == 0
    assert robot.lines()[-2:] == ["0.0", "closed"]


def test_motors_are_off_after_a_bug_too(processes: Processes, runtime: Path) -> None:
    robot = Recorded(processes, runtime)
    (bridge,) = children(robot.process.pid)
    bug = robot.record.with_suffix(".bug")
    bug.touch()
    wait_until(lambda: robot.process.poll() is not None)
    assert robot.process.returncode == DEFECT
    assert robot.lines()[-2:] == ["0.0", "closed"]
    wait_until(lambda: not alive(bridge))


def test_systemd_hears_of_progress_and_the_next_process_is_ready_sooner(processes: Processes, runtime: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(runtime / "systemd"))
        systemd.settimeout(60)

        def progress_before_ready() -> int:
            process = processes.start("-m", "sim.body", NOTIFY_SOCKET=str(runtime / "systemd"))
            count = 0
            while (message := systemd.recv(4096).decode()) != "READY=1":
                assert message == "WATCHDOG=1"
                count += 1
            process.kill()
            process.wait()
            systemd.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while systemd.recv(4096):
                    pass  # what it still said must not be taken for the next one's
            systemd.settimeout(60)
            return count

        # The gyro's zero takes two seconds: progress first, then ready, and nothing of the bridge's own life.
        first = progress_before_ready()
        assert first >= 2
        assert progress_before_ready() < first
        assert (runtime / "balancer.zero").exists()


def test_systemd_hears_of_the_end(processes: Processes, runtime: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(runtime / "systemd"))
        systemd.settimeout(60)
        process = processes.start("-m", "sim.body", NOTIFY_SOCKET=str(runtime / "systemd"))
        assert systemd.recv(4096) == b"WATCHDOG=1"
        stop(process)
        while (last := systemd.recv(4096)) in (b"WATCHDOG=1", b"READY=1"):
            pass  # from before the signal
        assert last == b"STOPPING=1"


def test_the_loop_stays_light(processes: Processes) -> None:
    """What the process with the deadline loads: no Zenoh, no asyncio, no numpy, no threads."""
    code = (
        "import sys, services.balancer.loop;"
        "heavy = {'zenoh', 'swarm.bus.zenoh_bus', 'swarm.process.service', 'asyncio', 'numpy', 'subprocess', 'smbus2'};"
        "print(*heavy & set(sys.modules))"
    )
    assert processes.start("-c", code).communicate(timeout=60)[0].strip() == ""


def test_a_wrong_seed_is_named(processes: Processes) -> None:
    process = processes.start("-m", "sim.body", SWARM_SEED="lucky")
    assert process.communicate(timeout=60)[1] == "body.py: SWARM_SEED='lucky': expected an integer\n"
    assert process.returncode == 2


def test_the_devices_over_the_bus(processes: Processes, watcher: Watcher) -> None:
    processes.start_ready("-m", "sim.body")
    watcher.wait_balancing()
    wait_until(lambda: watcher.last("battery") is not None and watcher.last("battery").voltage == 7.4)
    wait_until(lambda: watcher.last("buttons") is not None and watcher.last("buttons").presses_a == 0)
    wait_until(lambda: watcher.last("uwb") is not None)
    assert watcher.last("uwb").state == "silent", "no module is wired to this one"

    wait_until(lambda: watcher.last("display") is not None and watcher.last("display").present)
    wait_until(lambda: watcher.last("display").lines[:2] == ("r0", "balancing       7.4 V"))
    watcher.bus.publish("swarm/r0/app/consensus/state/throttled", AppState(1.0, 3, {"value": 2.5}, {}))
    wait_until(lambda: watcher.last("display").lines[3:] == ("consensus k=3", "value 2.5"))
    watcher.command("display", SetDisplay("hello"))
    wait_until(lambda: watcher.last("display").lines[3:] == ("hello",))

    watcher.command("imu", ImuRequest(100.0, 0.5))
    wait_until(lambda: len(watcher.heard["imu"]) > 3)  # of 50, where the machine keeps up
    watcher.command("module", ModuleRequest("mine", b"\x08\x00"))
    wait_until(lambda: watcher.last("module") is not None)
    assert watcher.last("module").problem == "the module does not answer"
    watcher.command("notes", SetNotes((Note(440.0, 0.1, 1.0),)))

    refused = [
        ("notes", SetNotes((Note(440.0, 9.0, 1.0),))),
        ("imu", ImuRequest(1000.0, 1.0)),
        ("module", ModuleRequest("x", b"\x08\x01")),
        ("i2c", MeasureI2C("x", 99, 1)),
        ("display", SetDisplay("x" * 1000)),
    ]
    for what, message in refused:
        watcher.command(what, message)
    replies: list[bytes] = []

    def all_refused() -> bool:
        watcher.bus.ask("swarm/r0/balancer/status", lambda _, payload: replies.append(payload))
        found = [read("swarm/r0/balancer/status", reply).counters.get("refused") for reply in replies]
        return len(refused) in found

    wait_until(all_refused)
    watcher.assert_balancing()


def test_swarm_measure_i2c_asks_the_balancer(processes: Processes, watcher: Watcher) -> None:
    processes.start_ready("-m", "sim.body")
    watcher.wait_balancing()
    command = [sys.executable, "-m", "laptop.cli", "measure", "i2c", "--sizes", "8", "--count", "20", "--json"]
    done = subprocess.run(command, env=processes.environment(), capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    (found,) = json.loads(done.stdout)["r0"]
    assert (found["size"], found["count"], found["failed"]) == (8, 20, 0)
    # 1.30 and 1.17 ms on the wire and in holds, two pauses and one; Python and its sleeps come on top, for real.
    assert 0 < found["read"] < 8 * 8 / 1.60e-3
    assert 0 < found["write"] < 8 * 8 / 1.32e-3
