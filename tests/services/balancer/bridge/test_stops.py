"""The stop of a real balancer service: what it overtakes, what it voids, and that no payload keeps it from stopping."""

import os
import signal
import subprocess

import msgpack
from conftest import Processes, wait_until
from process_rig import Watcher, watcher

from services.balancer.bridge.link import COMMANDS_A_TICK
from swarm import clock
from swarm.messages import SetLeds, SetMode, SetVelocity, Stop, Stopped, TryMotors, read
from swarm.messages.service import stop_of

__all__ = ["watcher"]

STATUS = "swarm/r0/balancer/status"
PROPER = {"t": 1.0, "origin": "r1", "reason": "enough"}
PAYLOADS = {
    "nothing": (b"", "unreadable stop message (by unknown)"),
    "text": (b"stop!", "unreadable stop message (by unknown)"),
    "a field more": (msgpack.packb({**PROPER, "severity": 3}), "enough (by r1)"),
    "a field less": (msgpack.packb({"t": 1.0, "origin": "r1"}), "no reason given (by r1)"),
    "no time": (msgpack.packb({**PROPER, "t": float("nan")}), "enough (by r1)"),
    "much": (bytes(900_000), "unreadable stop message (by unknown)"),
}


def lying(processes: Processes, watcher: Watcher) -> "subprocess.Popen[str]":
    """A robot that lies on its front and waits for a command. One that stands could fall by itself on a busy machine,
    and the fault would be that."""
    body = processes.start_ready("-m", "sim.body", SWARM_SIM_LYING="front")
    watcher.wait_mode("idle")
    return body


def take_back(watcher: Watcher, reason: str) -> None:
    """Tell what r0's mesh tells when it knows of a stop, and when all stops are taken back."""
    watcher.bus.publish("swarm/r0/mesh/stopped", Stopped(clock.now(), True, {"r0": reason}))
    watcher.bus.publish("swarm/r0/mesh/stopped", Stopped(clock.now(), False, {}))


class Held:
    """A robot whose loop is held, so that what the bridge hands over waits for it."""

    def __init__(self, processes: Processes, watcher: Watcher) -> None:
        self.body = lying(processes, watcher)
        self.watcher = watcher
        self.body.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.body.pid, os.WSTOPPED)

    def go_on(self) -> None:
        """Let the loop go on when the bridge has handled all that was published before."""
        self.watcher.command("mode", SetMode("dance"))
        replies: list[bytes] = []

        def refused() -> bool:
            self.watcher.bus.ask(STATUS, lambda _, payload: replies.append(payload))
            return any("refused" in read(STATUS, reply).counters for reply in replies)

        wait_until(refused, what="the bridge has handled everything")
        self.body.send_signal(signal.SIGCONT)


def test_a_stop_overtakes_a_flood_of_velocity_commands(processes: Processes, watcher: Watcher) -> None:
    held = Held(processes, watcher)
    for _ in range(2000):
        watcher.command("velocity", SetVelocity(0.1, 0.0, 10.0))
    watcher.bus.publish("swarm/stop", Stop(0.0, "test", "enough"))
    held.go_on()
    assert watcher.wait_mode("fault").fault == "stopped: enough (by test)"


def test_a_command_from_before_a_stop_moves_nothing_after_it(processes: Processes, watcher: Watcher) -> None:
    held = Held(processes, watcher)
    # It may be held after its look for a stop and before it takes commands: then it first takes these.
    for _ in range(COMMANDS_A_TICK):
        watcher.command("leds", SetLeds(False, False, True, 60.0))
    watcher.command("mode", SetMode("stand"))
    watcher.command("velocity", SetVelocity(0.1, 0.0, 10.0))
    watcher.command("leds", SetLeds(True, True, False, 60.0))
    watcher.bus.publish("swarm/stop", Stop(0.0, "test", "enough"))
    held.go_on()
    void = ("is void", "the swarm is stopped")  # the loop says the one, the bridge the other
    wait_until(
        lambda: sum(notice.text.count(why) for notice in watcher.heard["notice"] for why in void) == 2,
        what="both are told of",
    )
    assert watcher.wait_mode("fault").fault == "stopped: enough (by test)"
    # What is given after the stop was taken back counts.
    take_back(watcher, "enough")
    watcher.command("mode", SetMode("stand"))
    watcher.wait_mode("standing_up")


def test_nothing_moves_while_the_swarm_is_stopped(processes: Processes, watcher: Watcher) -> None:
    lying(processes, watcher)
    watcher.bus.publish("swarm/stop", Stop(0.0, "test", "enough"))
    watcher.wait_mode("fault")
    watcher.command("mode", SetMode("stand"))
    watcher.command("velocity", SetVelocity(0.1, 0.0, 10.0))
    watcher.command("motors", TryMotors(0.1, 0.1, 1.0))
    watcher.command("leds", SetLeds(True, True, False, 60.0))
    refused = "refused: swarm/r0/balancer/set/{}: the swarm is stopped: swarm arm takes that back"
    wait_until(
        lambda: (
            {notice.text for notice in watcher.heard["notice"]}
            >= {refused.format(what) for what in ("mode", "velocity", "motors")}
        ),
        what="each command that moves is refused",
    )
    assert watcher.last().mode == "fault"
    wait_until(lambda: watcher.heard["leds"] and watcher.heard["leds"][-1].yellow, what="LEDs are obeyed")
    # Another robot's mesh, what was told before the stop, or a damaged sample takes nothing back.
    watcher.bus.publish("swarm/r1/mesh/stopped", Stopped(clock.now(), False, {}))
    watcher.bus.publish("swarm/r0/mesh/stopped", Stopped(1.0, False, {}))
    watcher.bus.publish("swarm/r0/mesh/stopped", b"\x00")
    watcher.command("mode", SetMode("stand"))
    wait_until(lambda: sum("stopped: swarm arm" in each.text for each in watcher.heard["notice"]) == 4)
    assert watcher.last().mode == "fault"
    take_back(watcher, "enough")
    watcher.command("mode", SetMode("stand"))
    watcher.wait_mode("standing_up")


def test_any_sample_of_the_stop_key_stops_the_robot(processes: Processes, watcher: Watcher) -> None:
    lying(processes, watcher)
    reason = ""
    samples = [("swarm/stop", *each) for each in PAYLOADS.values()]
    for key, payload, why in (*samples, ("swarm/*", b"all", samples[0][2]), ("swarm/**", b"all", samples[0][2])):
        take_back(watcher, reason)
        reason = stop_of(payload).reason
        watcher.command("mode", SetMode("stand"))
        wait_until(lambda: watcher.last() is not None and watcher.last().mode in ("standing_up", "balancing"))
        watcher.bus.publish(key, payload)
        assert watcher.wait_mode("fault").fault == f"stopped: {why}"
