"""Balancer and dwm under virtual time, through the clients that apps use."""

import math
from dataclasses import replace

import pytest

from services.mesh.links.radio_model import AirModel
from sim.core.actions import BodyPlace, Lay, Press, Push
from sim.scenario.options import FROM_START, parse
from sim.scenario.scenario import build
from sim.virtual.bus import VirtualBus
from sim.virtual.run import PLACE, VirtualRun
from sim.virtual.world import VirtualWorld
from swarm.app.devices import Devices
from swarm.errors import LocalError
from swarm.messages import BalancerState, LedChange, Notice, Ranges, Stop, read


class Rig:
    def __init__(self, *options, lying=None, height=0.0):
        config, air = build(parse(list(options)), PLACE).config, AirModel(latency=0.03)
        anchors = tuple(replace(anchor, z=height) for anchor in config.anchors)
        config = replace(config, anchors=anchors, dwm=replace(config.dwm, height=height))
        self.world = VirtualWorld(config, air, 1, mesh=FROM_START, lying=lying)
        self.bus = VirtualBus(self.world.robots["r0"].router)
        self.time = self.world.time
        self.devices = Devices(self.bus, "r0", lambda: self.time.now)
        self.heard = []
        self.bus.subscribe("swarm/r0/**", lambda key, payload: self.heard.append((self.time.now, key, payload)))

    @property
    def body(self):
        return self.world.robots["r0"].balancer.body

    def run(self, seconds):
        """Time, and what the host does for the devices of an app."""
        end = self.time.now + seconds
        while self.time.now < end:
            self.time.run(min(end, self.time.now + 0.05))
            self.devices.handle_timer()
        self.time.run(end)

    def messages(self, kind):
        found = [(at, read(key, payload)) for at, key, payload in self.heard if "/sync/" not in key]
        return [(at, message) for at, message in found if isinstance(message, kind)]


@pytest.fixture
def rig():
    return Rig("--robots", "3")


def test_an_app_reads_posture_battery_and_buttons(rig):
    pressed = []
    rig.devices.on_button(pressed.append)
    assert rig.devices.posture == "unknown"
    rig.run(2.0)
    assert rig.devices.posture == "standing"
    assert rig.devices.battery is None
    rig.time.at(rig.time.now + 0.5, rig.world.act, "r0", Press("B", 0.2))
    rig.run(0.6)
    assert rig.devices.buttons == ("b",)
    rig.run(1.0)
    assert (rig.devices.buttons, pressed) == ((), ["b"])
    assert rig.devices.battery == pytest.approx(7.4)
    rig.devices.mode("lie")
    rig.run(0.2)
    assert rig.devices.posture == "lying_down"
    rig.run(1.0)
    assert rig.devices.posture == "front"
    rig.world.act("r0", Lay("back"))
    rig.run(0.1)
    assert rig.devices.posture == "back"
    rig.devices.mode("stand")
    rig.run(0.3)
    assert rig.devices.posture == "standing_up"
    rig.run(1.0)
    assert rig.devices.posture == "standing"


def test_what_is_driven_stops_with_the_app(rig):
    x = rig.body.x
    rig.run(1.0)
    rig.devices.drive(0.2, 0.0)
    rig.run(2.0)
    assert rig.body.x - x == pytest.approx(0.4, abs=0.05)
    rig.time.run(rig.time.now + 3.0)  # nobody repeats the command: the app is dead
    still = rig.body.x
    rig.time.run(rig.time.now + 1.0)
    assert rig.body.x == still < x + 0.7


def test_leds_are_told_when_they_change_and_go_back_to_the_robots_own(rig):
    rig.run(1.0)
    rig.devices.leds(True, None, False, None)
    rig.run(4.0)
    rig.devices.release()
    rig.run(1.0)
    changes = [(round(at, 3), message.red, message.green) for at, message in rig.messages(LedChange)]
    assert [change[1:] for change in changes] == [(False, True), (True, False), (False, True)]
    assert changes[1][0] == 1.0
    assert rig.world.robots["r0"].balancer.shown == (False, False, True)


def test_a_stop_holds_and_refusals_are_told(rig):
    rig.run(0.5)
    rig.bus.publish("swarm/stop", Stop(rig.time.now, "r1", "test"))
    rig.devices.drive(0.1, 0.0)
    rig.run(0.3)
    rig.devices.drive(0.0, 0.0)
    assert "test" in rig.devices.fault or rig.devices.posture == "unknown"
    rig.run(0.5)
    assert "test" in rig.devices.fault
    assert rig.body.posture == "front"
    assert any("refused" in message.text for _, message in rig.messages(Notice))
    # it reached the others through the mesh
    assert all(robot.balancer.body.fault for robot in rig.world.robots.values())


def test_a_robot_that_is_switched_on_stands_up_unless_a_stop_holds(rig):
    rig.run(0.5)
    rig.world.switch_off("r0", 1.0)
    rig.run(4.5)
    assert rig.body.mode == "balancing"
    rig.world.switch_off("r0", 1.0)
    rig.run(0.5)
    VirtualBus(rig.world.robots["r1"].router).publish("swarm/stop", Stop(rig.time.now, "r1", "test"))
    rig.run(8.0)
    assert rig.body.fault == "stopped: test (by r1)"
    assert [at for at, message in rig.messages(BalancerState) if message.mode == "standing_up" and at > 6.0] == []


def test_a_stopped_robot_that_is_switched_off_and_on_alone_stays_stopped(rig):
    rig.run(0.5)
    rig.bus.publish("swarm/stop", Stop(rig.time.now, "r0", "test"))
    rig.run(1.0)
    for peer in ("r1", "r2"):
        rig.world.switch_off(peer, 60.0)
    rig.world.switch_off("r0", 1.0)
    rig.run(2.0)
    rig.devices.drive(0.1, 0.0)
    rig.run(6.0)
    assert rig.body.fault == "stopped: test (by r0)"
    assert rig.body.mode == "fault"


def test_a_robot_that_was_switched_off_has_lost_the_leds_of_before_and_keeps_those_of_after(rig):
    balancer = rig.world.robots["r0"].balancer
    rig.run(0.5)
    balancer.claim_leds((True, False, True), 60.0, rig.time.now)
    rig.world.switch_off("r0", 1.0)
    rig.run(1.5)
    assert balancer.shown != (True, False, True)
    balancer.claim_leds((True, True, True), 60.0, rig.time.now)
    rig.run(4.0)
    assert rig.body.mode == "balancing"
    assert balancer.shown == (True, True, True)


def test_a_robot_that_begins_lying_lies_also_after_it_was_switched_on():
    rig = Rig("--robots", "2", lying="back")
    rig.world.switch_off("r0", 1.0)
    rig.run(6.0)
    assert rig.body.mode == "idle"


def test_a_body_without_physics_bears_a_push_or_falls(rig):
    balancer = rig.world.robots["r0"].balancer
    rig.run(1.0)
    x = balancer.body.x
    balancer.act(Push(0.4))
    assert (balancer.body.mode, balancer.body.x) == ("balancing", x)
    rig.run(2.0)
    balancer.act(Push(-0.5))
    assert (balancer.body.mode, balancer.body.posture, balancer.body.fault) == ("fault", "back", "fell")
    assert balancer.body.x == pytest.approx(x - 0.5)
    balancer.command("stand", rig.world.time.now)
    rig.run(3.0)
    assert balancer.body.mode == "balancing"
    with pytest.raises(LocalError, match="cannot be put elsewhere"):
        balancer.act(BodyPlace(0.0, 0.0, 0.0, 0.0, held=False))


def test_the_pose_comes_through_module_calibration_and_filter(rig):
    rig.run(1.0)
    assert rig.devices.pose is None  # nobody looked before
    rig.run(1.0)
    pose = rig.devices.pose
    assert math.dist((pose.x, pose.y), (rig.body.x, rig.body.y)) < 0.3
    for _ in range(8):
        rig.devices.drive(0.2, 0.4)
        rig.run(2.0)
    rig.devices.drive(0.0, 0.0)
    rig.run(4.0)
    pose = rig.devices.pose
    assert pose.sigma_x < 0.1
    assert math.dist((pose.x, pose.y), (rig.body.x, rig.body.y)) < 0.15
    error = (pose.heading - rig.body.heading + math.pi) % (2 * math.pi) - math.pi
    assert abs(error) < 0.3


def test_antennas_and_the_target_are_at_the_configured_height():
    rig = Rig("--robots", "3", height=30.0)
    rig.run(2.0)
    (_, ranges) = rig.messages(Ranges)[-1]
    assert len(ranges.ranges) == 4
    assert all(item.raw < 5.0 for item in ranges.ranges)


def test_nothing_is_measured_for_nobody():
    rig = Rig("--robots", "2")
    rig.bus.close()
    rig.time.run(3.0)
    assert rig.world.robots["r1"].dwm.counters["reports"] == 0


@pytest.mark.parametrize("payload", [b"", b"stop!", b"\x80", Stop(math.nan, "somebody", "x" * 100_000)])
def test_any_sample_of_the_stop_key_on_one_robot_stops_all(rig, payload):
    rig.run(2.0)
    bodies = [robot.balancer.body for robot in rig.world.robots.values()]
    assert [body.fault for body in bodies] == [""] * 3
    rig.bus.publish("swarm/stop", payload)
    rig.run(1.0)
    assert [body.fault.startswith("stopped: ") for body in bodies] == [True] * 3
    assert max(len(body.fault) for body in bodies) < 300


DRIVES = """
from swarm import SyncApp
class Drives(SyncApp):
    value: float
    def step(self, neighbours):
        self.value += 1
        self.robot.drive(0.1, 0.0)
        self.robot.leds(True, False, False)
"""


def test_a_robot_stands_still_while_its_lockstep_waits_and_keeps_its_leds(tmp_path):
    file = tmp_path / "drives.py"
    file.write_text(DRIVES)
    options = parse([str(file), "--robots", "2", "--seconds", "12", "--cut", "r0-r1@2s,6s", "--virtual"])
    run = VirtualRun(options, build(options, PLACE))
    robot = run.world.robots["r0"]
    found = {}
    for at in (1.0, 4.5, 7.8, 11.9):
        run.world.time.at(at, lambda at=at: found.update({at: robot.balancer.body.x}))
    run.world.time.at(7.8, lambda: found.update(red=robot.balancer.shown[0]))
    run.go()
    assert found[4.5] - found[1.0] > 0.1
    assert found[7.8] == pytest.approx(found[4.5], abs=0.01)
    assert found["red"]
    assert found[11.9] > found[7.8] + 0.02


def test_the_lockstep_of_a_robot_that_is_done_is_idle_at_once(tmp_path):
    file = tmp_path / "drives.py"
    file.write_text(DRIVES)
    options = parse([str(file), "--robots", "2", "--iterations", "20", "--virtual"])
    run = VirtualRun(options, build(options, PLACE))
    run.go()
    assert all(robot.apps["drives"].drivers[""].idle for robot in run.world.robots.values())
