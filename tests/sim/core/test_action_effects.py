"""Acts of a person on simulated robots: the acts, the body's answer under virtual time, and real processes."""

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
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
from balancer_rig import Rig, upright
from conftest import Processes, wait_until
from hypothesis import given
from hypothesis import strategies as st

from bench.rigs.running import running
from sim.control import datagrams
from sim.core.action_effects import ActionEffects
from sim.core.actions import BodyPlace, Carry, Lay, Press, Push, Unplug, check, pack, unpack
from sim.devices.world_client import WORLD_SOCKET, WorldClient
from sim.world import BodyWorld, LedReport
from swarm import clock
from swarm import config as configuration
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, RemoteError
from swarm.messages import BalancerState, Buttons, LedChange, SetMode, Truth, read
from swarm.messages.codec import decode

CLAIM = """
import sys
from pathlib import Path
from swarm.process.simulations import claim
with claim(Path(sys.argv[1])):
    print("claimed", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize(
    "act",
    [
        Press("B", 0.5),
        Push(-0.2),
        Lay("back"),
        Unplug("imu", True),
        Carry(1, 2, 0.3),
        BodyPlace(1.0, 2.0, 0.3, -1.9, False),
    ],
)
def test_an_act_survives_its_datagram(act) -> None:
    assert unpack(pack(act)) == act


@given(st.binary(max_size=60))
def test_any_datagram_is_an_act_or_refused(data: bytes) -> None:
    for prefix in (b"", b"press:", b"push:", b"lay:", b"unplug:", b"place:"):
        with contextlib.suppress(LocalError, RemoteError):
            act = unpack(prefix + data)
            assert unpack(pack(act)) == act


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (Press("D", 0.2), "no button 'D', there are A, B, C"),
        (Press("A", 0.0), "hold: expected a time above 0 up to 60 s, got 0"),
        (Press("A", math.nan), "hold: expected"),
        (Push(0.0), "impulse: expected at most 2 N s either way, not 0, got 0"),
        (Push(9.0), "got 9"),
        (Push(math.nan), "got nan"),
        (Lay("side"), "no side 'side', there are back and front"),
        (Unplug("leg"), "no device 'leg', there are imu, atmega, display"),
    ],
)
def test_what_cannot_be_done_is_named(act, message: str) -> None:
    with pytest.raises(LocalError, match=message):
        check(act)


def test_a_button_is_held_and_let_go() -> None:
    rig = Rig(start_mode="rest").run(0.1)
    effects = ActionEffects(rig.robot)
    effects.do(Press("A", 0.5), rig.now)
    effects.do(Press("C", 1.0), rig.now)
    for seconds, expected in ((0.3, (True, False, True)), (0.5, (False, False, True)), (0.5, (False, False, False))):
        rig.run(seconds)
        effects.handle_timer(rig.now)
        assert rig.run(0.05).balancer.motion.buttons == sum(1 << bit for bit, held in enumerate(expected) if held)


@pytest.mark.parametrize(("side", "sign"), [("back", -1), ("front", 1)])
def test_a_laid_robot_is_down_and_says_so_and_stands_up_on_command(side: str, sign: int) -> None:
    rig = upright().run(2)
    ActionEffects(rig.robot).do(Lay(side), rig.now)
    rig.run(3)
    assert rig.body.tilt == pytest.approx(sign * math.radians(110))
    assert (rig.balancer.mode, rig.balancer.posture) == ("fault", side)
    assert rig.balancer.fault.name == "fell"
    assert rig.robot.atmega.motors == (0.0, 0.0)
    rig.run(5)
    assert rig.balancer.mode == "fault"
    rig.balancer.command("stand", rig.now)
    assert rig.run(8).balancer.mode == "balancing"


def test_turned_over_from_one_side_to_the_other() -> None:
    rig = Rig(start_mode="rest", tilt=math.radians(110), held=False).run(4)
    ActionEffects(rig.robot).do(Lay("back"), rig.now)
    rig.run(4)
    assert rig.balancer.posture == "back"
    rig.balancer.command("stand", rig.now)
    assert rig.run(8).balancer.mode == "balancing"


@pytest.mark.parametrize("impulse", [0.1, 0.15, 0.3])
@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_a_pushed_robot_returns_even_where_its_loop_is_late_once(impulse: float, late_s: float) -> None:
    rig = upright().run(3)
    start, late_tick = rig.body.x, rig.tick + 5
    rig.lateness = lambda tick: late_s if tick == late_tick else 0.0
    ActionEffects(rig.robot).do(Push(impulse), rig.now)
    rig.run(0.5)
    assert rig.body.x > start + 0.02
    rig.run(10)
    assert rig.balancer.mode == "balancing"
    assert abs(rig.body.x - start) < 0.05


@pytest.mark.parametrize("late_tick", [1, 10, 40])
def test_a_robot_that_falls_while_its_loop_stands_still_keeps_its_motors_off_until_a_command(late_tick: int) -> None:
    """A simulated body falls in real time: where its host stands still for half a second after a push, it falls."""
    rig = upright().run(3)
    late_tick += rig.tick
    rig.lateness = lambda tick: 0.5 if tick == late_tick else 0.0
    ActionEffects(rig.robot).do(Push(0.15), rig.now)
    rig.run(5)
    assert rig.balancer.mode == "fault"
    assert rig.robot.atmega.motors == (0.0, 0.0)
    rig.balancer.command("stand", rig.now)
    assert rig.run(8).balancer.mode == "balancing"


def test_a_body_that_is_put_down_lies_where_it_was() -> None:
    rig = Rig(start_mode="stand")
    ActionEffects(rig.robot).do(BodyPlace(1.5, -0.5, 0.7, -0.1, False), rig.now)
    rig.run(1)
    assert (rig.body.x, rig.body.y, rig.body.heading) == (1.5, -0.5, 0.7)
    assert rig.body.tilt == pytest.approx(-math.radians(110))
    assert rig.run(8).balancer.mode == "balancing"
    ActionEffects(rig.robot).do(BodyPlace(9.0, 9.0, 0.0, 0.0, True), rig.now)
    assert rig.body.x < 3.0, "a body in its hand begins at its own place"


@pytest.mark.parametrize("mode", ["rest", "stand"])
def test_a_robot_that_is_carried_somewhere_lies_still_there_with_its_motors_off(mode: str) -> None:
    rig = upright() if mode == "stand" else Rig(start_mode="rest")
    rig.run(2)
    ActionEffects(rig.robot).do(Carry(1.5, -0.5, 0.7), rig.now)
    rig.run(4)
    assert math.dist((rig.body.x, rig.body.y), (1.5, -0.5)) < 0.01
    assert rig.body.tilt == pytest.approx(-math.radians(110))
    assert rig.robot.atmega.motors == (0.0, 0.0)
    assert rig.balancer.mode == ("idle" if mode == "rest" else "fault")


def test_a_change_of_leds_waits_for_room_at_a_busy_world(runtime: Path) -> None:
    rig, place = upright(), runtime / "r0"
    place.mkdir()
    client = WorldClient("r0", rig.robot, place, 0.0)
    with contextlib.closing(client._socket), contextlib.closing(datagrams.listen(runtime, WORLD_SOCKET)) as world:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other, contextlib.suppress(BlockingIOError):
            other.setblocking(False)
            while True:
                other.sendto(b"full", str(runtime / WORLD_SOCKET))
        rig.robot.atmega.led_changes.clear()
        rig.robot.atmega.led_changes.append((7.0, (False, True, False)))
        client.look(1.0)
        with contextlib.suppress(BlockingIOError):
            while world.recv(100) == b"full":
                pass
        client.look(1.01)
        told = decode(LedReport, world.recv(100), WORLD_SOCKET)
        assert told == LedReport("r0", 7.0, red=False, yellow=True, green=False)


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

    robot.wait_balancing()
    assert balance("lie")[0] == 0
    assert robot.states[-1].mode == "idle"
    code, row = balance("lie")
    assert (code, row["ok"]) == (1, False)
    assert "swarm balance stand makes it stand" in str(row["text"])
    robot.hand("lay", "r0", "back")
    wait_until(lambda: robot.states[-1].posture == "back", what="it lies")
    assert balance("stand") == (0, {"ok": True, "text": "stands"})


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

    with begun():
        assert not termios.tcgetattr(end)[3] & termios.ECHO
        os.write(terminal, b"w")
        wait_until(lambda: demanded() > 0.05, what="it drives forward")
        wait_until(lambda: demanded() == 0.0, what="it stops: no key has come again")
        os.write(terminal, b"\x1b[B")
        wait_until(lambda: demanded() < -0.05, what="it drives backward")
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
            time.sleep(1.5)  # the hand takes its time, and the person looks
        if what and what != "again" and not what.startswith(("press", "roll", "tip-a-bit")):
            command.stdin.write("a")
            command.stdin.flush()
        assert what != "again", reports or said
    assert command.wait(60) == 0
    assert reports[0]["verdict"] == "passed"
