"""Acts of a person on simulated robots: the acts, and the body's answer under virtual time."""

import contextlib
import math
import socket
from pathlib import Path

import pytest
from balancer_rig import Rig, upright
from hypothesis import given
from hypothesis import strategies as st

from sim.control import datagrams
from sim.core.action_effects import ActionEffects
from sim.core.actions import BodyPlace, Carry, Lay, Press, Push, Unplug, check, pack, unpack
from sim.devices.world_client import WORLD_SOCKET, WorldClient
from sim.world import LedReport
from swarm.errors import LocalError, RemoteError
from swarm.messages.codec import decode


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
    with contextlib.closing(client._socket), contextlib.closing(datagrams.receiver(runtime, WORLD_SOCKET)) as world:
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
