"""Acts of a person and commands reach a simulated robot of real processes."""

import contextlib
import json
import math
import os
import pty
import select
import socket
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
from conftest import Processes, wait_until

from bench.rigs.running import running
from sim.core.actions import BodyPlace, unpack
from sim.world import BodyWorld
from swarm import clock
from swarm import config as configuration
from swarm.bus.zenoh_bus import Bus
from swarm.messages import BalancerState, Buttons, LedChange, SetMode, Truth, read

CLAIM = """
import sys
from pathlib import Path
from swarm.process.simulations import claim
with claim(Path(sys.argv[1])):
    print("claimed", flush=True)
    sys.stdin.read()
"""


class Robot:
    """A simulated robot of real processes in a run directory that counts as a running simulation."""

    def __init__(self, processes: Processes, runtime: Path) -> None:
        self.run, self.robot = runtime / "run", runtime / "run" / "r0"
        self.processes = processes
        self.holder = processes.start("-c", CLAIM, str(self.run))
        assert self.holder.stdout.readline() == "claimed\n"
        self.robot.mkdir()
        self.world = BodyWorld(self.run, configuration.load(processes.config), 1, lambda robot, truth: self.seen(truth))
        self.truths: list[Truth] = []
        self.lamps: list[LedChange] = []
        self.states: list[BalancerState] = []
        self.buttons: list[Buttons] = []
        processes.start_ready("-m", "services.bus", SWARM_RUNTIME=str(self.robot))
        self.body = self.start()
        self.bus = Bus.of(self.robot)
        self.bus.subscribe(["swarm/r0/balancer/state", "swarm/r0/balancer/buttons"], self.take)

    def start(self):
        return self.processes.start("-m", "sim.body", SWARM_RUNTIME=str(self.robot))

    def seen(self, message: Truth | LedChange) -> None:
        if isinstance(message, Truth):
            self.truths.append(message)
        else:
            self.lamps.append(message)

    @property
    def truth(self) -> Truth | None:
        return self.truths[-1] if self.truths else None

    def take(self, key: str, payload: bytes) -> None:
        message = read(key, payload)
        (self.states if isinstance(message, BalancerState) else self.buttons).append(message)

    def told_after(self, t: float) -> bool:
        return bool(self.states) and self.states[-1].t > t

    def wait_balancing(self) -> None:
        """Wait until it balances; order it to stand up again where it has fallen. Its body falls in real time,
        so a host that stands still for a fifth of a second can make it fall (tests with `Rig` have a time of their
        own)."""
        ordered = -math.inf

        def balances() -> bool:
            nonlocal ordered
            mode = self.states[-1].mode if self.states else ""
            if mode == "fault" and clock.now() > ordered + 1.0:
                ordered = clock.now()
                self.bus.publish("swarm/r0/balancer/set/mode", SetMode("stand"))
            return mode == "balancing"

        wait_until(balances, what="it balances")

    def hand(self, *words: str) -> str:
        command = self.processes.start("-m", "laptop.cli", "hand", *words, "--run-dir", str(self.run))
        out, error = command.communicate(timeout=60)
        assert command.returncode == 0, error
        return out


@pytest.fixture
def robot(processes: Processes, runtime: Path):
    robot = Robot(processes, runtime)
    yield robot
    robot.bus.close()
    robot.world.close()


def test_hands_reach_a_running_robot(robot: Robot) -> None:
    robot.wait_balancing()

    assert robot.hand("press", "r0", "A", "--hold", "1") == "r0: button A held for 1 s\n"
    wait_until(lambda: any(buttons.a for buttons in robot.buttons), what="button A is down")
    wait_until(lambda: not robot.buttons[-1].a, what="and up again")
    assert not any(buttons.b or buttons.c for buttons in robot.buttons)

    wait_until(lambda: robot.truth is not None)
    wait_until(
        lambda: robot.lamps and (robot.lamps[-1].yellow, robot.lamps[-1].green) == (False, True),
        what="the world sees what its LEDs show",
    )
    start = robot.truth.x
    assert robot.hand("push", "r0", "--impulse", "0.2") == "r0: pushed with 0.2 N s\n"
    wait_until(lambda: any(abs(truth.x - start) > 0.03 for truth in robot.truths), what="it is pushed away")

    assert robot.hand("lay", "r0", "back") == "r0: laid on its back\n"
    wait_until(lambda: (robot.states[-1].mode, robot.states[-1].posture) == ("fault", "back"), what="it lies")
    robot.wait_balancing()  # caught while it swings up
    wait_until(lambda: any(state.posture == "upright" for state in robot.states[-25:]), what="it stands")

    assert robot.hand("place", "r0", "1.5", "-0.5") == "r0: lies on its back at (1.5, -0.5) m\n"
    # 1.6 m away. Its motors run until its loop has seen that it lies, which is late on a busy machine: it may roll on.
    wait_until(lambda: math.dist((robot.truth.x, robot.truth.y), (1.5, -0.5)) < 0.6, what="it is there")
    wait_until(lambda: robot.states[-1].posture == "back", what="it lies")


def test_a_killed_balancers_body_is_where_it_was_when_it_comes_back(robot: Robot) -> None:
    robot.wait_balancing()
    robot.hand("push", "r0", "--impulse", "0.3")  # it may fall where a busy machine makes its loop late
    wait_until(lambda: any(truth.x > 0.1 for truth in robot.truths), what="it is pushed away")
    robot.body.kill()
    robot.body.wait()
    ended = clock.now()
    robot.states.clear()
    robot.start()
    wait_until(lambda: robot.truth.t > ended, what="a body again")
    last = [truth for truth in robot.truths if truth.t <= ended][-1]
    first = next(truth for truth in robot.truths if truth.t > ended)
    # The last report is some 100 ms older than the kill at most: it rolled on a little.
    assert math.dist((first.x, first.y), (last.x, last.y)) < 0.15
    assert abs(first.tilt) == pytest.approx(math.radians(110), abs=0.01)
    robot.wait_balancing()


def test_a_world_answers_only_its_own_robots(processes: Processes, runtime: Path) -> None:
    (runtime / "r0").mkdir()
    world = BodyWorld(runtime, configuration.load(processes.config), 1, lambda robot, truth: None)
    with contextlib.closing(world), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as body:
        body.bind(str(runtime / "r0" / "body.sock"))
        body.settimeout(60)
        for hello in ({"robot": "nobody"}, {"robot": "../r0"}, {"nonsense": 1}, {"robot": "r0"}):
            body.sendto(msgpack.packb(hello), str(runtime / "world.sock"))
        assert unpack(body.recv(4096)) == BodyPlace(0.0, 0.0, 0.0, 0.0, True)
        pose = {"robot": "r0", "t": 1.0, "x": 1.0, "y": 2.0, "heading": 3.0, "tilt": 0.1, "held": False}
        body.sendto(msgpack.packb(pose), str(runtime / "world.sock"))
        body.sendto(msgpack.packb({"robot": "r0"}), str(runtime / "world.sock"))
        assert unpack(body.recv(4096)) == BodyPlace(1.0, 2.0, 3.0, 0.1, False)


@pytest.mark.parametrize("verb", ["press r9 A", "push r9", "lay r9 back"])
def test_a_robot_that_is_not_there_is_named(processes: Processes, runtime: Path, verb: str) -> None:
    command = processes.start("-m", "laptop.cli", "hand", *verb.split(), "--run-dir", str(runtime / "none"))
    assert "no simulation is running" in command.communicate(timeout=60)[1]
    assert command.returncode == 2
    holder = processes.start("-c", CLAIM, str(runtime / "run"))
    assert holder.stdout.readline() == "claimed\n"
    (runtime / "run" / "r0").mkdir()
    (runtime / "run" / "swarm.toml").write_text('[[robots]]\nname = "r0"\n')
    for robot, message in (("r9", "no robot 'r9'"), ("r0", "the body of r0 is not running at this moment")):
        words = verb.replace("r9", robot).split()
        command = processes.start("-m", "laptop.cli", "hand", *words, "--run-dir", str(runtime / "run"))
        assert message in command.communicate(timeout=60)[1]


def test_balance_commands_reach_a_running_robot_and_say_what_came_of_them(robot: Robot) -> None:
    def balance(mode: str) -> tuple[int, dict[str, object]]:
        command = robot.processes.start("-m", "laptop.cli", "balance", mode, "--run-dir", str(robot.run), "--json")
        out, error = command.communicate(timeout=60)
        assert not error
        return command.returncode, json.loads(out)["robots"]["r0"]

    def lies() -> bool:
        """Whether it has lain down by command; once more where it had fallen before, as on a busy host."""
        robot.wait_balancing()
        return balance("lie")[0] == 0

    wait_until(lies, what="it lies down")
    wait_until(lambda: robot.states[-1].mode == "idle", what="it is at rest")
    code, row = balance("lie")
    assert (code, row["ok"]) == (1, False)
    assert "swarm balance stand makes it stand" in str(row["text"])
    robot.hand("lay", "r0", "back")
    wait_until(lambda: robot.states[-1].posture == "back", what="it lies")
    wait_until(lambda: balance("stand") == (0, {"ok": True, "text": "stands"}), what="it stands")


@pytest.mark.slow
def test_a_robot_drives_by_keyboard_and_stops_when_the_key_is_let_go(robot: Robot) -> None:
    """At a terminal of its own, which is as before afterwards, whichever way it ends."""
    robot.wait_balancing()
    terminal, end = pty.openpty()
    before = termios.tcgetattr(end)

    @contextlib.contextmanager
    def begun() -> Iterator[subprocess.Popen[bytes]]:
        words = [sys.executable, "-m", "laptop.cli", "drive", "r0", "--run-dir", robot.run]
        environment = robot.processes.environment(SWARM_RUNTIME="")
        with running(words, env=environment, stdin=end, stdout=end, stderr=end) as process:
            wait_until(lambda: b"space" in said(), what="it says which keys there are")
            yield process

    def said() -> bytes:
        return os.read(terminal, 4096) if select.select([terminal], [], [], 0)[0] else b""

    def demanded() -> float:
        return robot.states[-1].demanded_speed

    def drives(key: bytes, sign: int) -> None:
        """Press a key until the robot drives as it says: one that has just fallen stays where it is."""
        since: list[BalancerState] = []

        def driven() -> bool:
            return any(sign * each.demanded_speed > 0.05 for each in since)

        while not driven():
            robot.wait_balancing()
            heard = len(robot.states)
            os.write(terminal, key)

            def seen(heard: int = heard) -> bool:
                since[:] = robot.states[heard:]
                return driven() or any(each.mode == "fault" for each in since)

            wait_until(seen, what=lambda: f"it drives by {key!r}: {robot.states[-1]}")

    with begun():
        assert not termios.tcgetattr(end)[3] & termios.ECHO
        drives(b"w", 1)
        wait_until(lambda: demanded() == 0.0, what="it stops: no key has come again")
        drives(b"\x1b[B", -1)
    assert termios.tcgetattr(end) == before
    wait_until(lambda: demanded() == 0.0, what="it stops: nobody drives it")

    with begun() as second:
        os.write(terminal, b"w ")
        wait_until(lambda: robot.states[-1].mode == "fault", what="space stops it")
        assert second.wait(60) == 1
    assert termios.tcgetattr(end) == before
    os.close(terminal)
    os.close(end)


COMMISSIONED = {
    "lay-back": ("lay", "r0", "back"),
    "lay-in-sight": ("lay", "r0", "back"),
    "lay-front": ("lay", "r0", "front"),
    "lift-upright": ("lift", "r0"),
    "tip-forward": ("lift", "r0", "--tilt", "90"),
    "turn-left": ("lift", "r0", "--turn", "90"),
    "roll-left": ("roll", "r0", "left"),
    "roll-right": ("roll", "r0", "right"),
    "tip-a-bit-forward": ("lift", "r0", "--tilt", "15"),
    "tip-a-bit-backward": ("lift", "r0", "--tilt", "-15"),
    "stand-on-floor": ("lift", "r0", "--down"),
    "press-a": ("press", "r0", "A"),
    "press-b": ("press", "r0", "B"),
    "press-c": ("press", "r0", "C"),
}
"""What a person does, in the words of `swarm hand`."""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_robot_of_real_processes_is_commissioned(robot: Robot, tmp_path: Path) -> None:
    (robot.run / "swarm.toml").write_text(robot.processes.config.read_text())
    robot.processes.start_ready("-m", "services.mesh", SWARM_RUNTIME=str(robot.robot))  # it takes back the stop
    words = ("-m", "laptop.cli", "commission", "r0", "--run-dir", str(robot.run), "--json")
    command = robot.processes.start(*words)
    reports = []
    for line in command.stdout:
        said = json.loads(line)
        reports += [said["report"]] if "report" in said else []
        if (what := said.get("ask", "")) in COMMISSIONED:
            robot.hand(*COMMISSIONED[what])
            looked = clock.now() + 1.5  # the hand takes its time, and the person looks
            wait_until(lambda looked=looked: robot.told_after(looked), what="what the robot tells of itself")
        if what and what != "again" and not what.startswith(("press", "roll", "tip-a-bit")):
            command.stdin.write("a")
            command.stdin.flush()
        assert what != "again", reports or said
    assert command.wait(60) == 0
    assert reports[0]["verdict"] == "passed"
