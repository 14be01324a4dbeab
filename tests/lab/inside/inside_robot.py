"""Runs inside the lab's robot, as root with the release's Python: breaks its I2C bus under the balancer, and looks.

Each check is a line of JSON in /share/report: its name, what went wrong (empty where nothing did), what was measured.
The host asserts (test_lab_robot.py).
"""

import json
import math
import os
import pwd
import stat
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lab.i2c.order import order
from lab.waiting import WaitedInVainError, until
from laptop.fleet.units import kill_command
from services.balancer.core.devices import balboa, imu
from swarm.bus.zenoh_bus import Bus
from swarm.messages import BalancerFault, BalancerState, Pose, SetMode
from swarm.messages.codec import decode

SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm")
APP = "swarm-app@led_sync"
FOR_GOOD = 10**9
"""Spoilt messages that do not end."""


class CheckFailed(Exception):
    """What a check expected is not so."""


def expect(condition: object, problem: str) -> None:
    if not condition:
        raise CheckFailed(problem)


def wait(condition: Callable[[], object], what: str, seconds: float = 20.0) -> float:
    """Wait until `condition()`; return the seconds it took."""
    began = time.monotonic()
    until(what, condition, seconds, robot.said)
    return time.monotonic() - began


def i2c(**faults: object) -> dict[str, Any]:
    return order("/run/lab/orders", faults)


def crash(service: str) -> None:
    """Kill it as the live page does."""
    subprocess.run(["sh", "-c", kill_command(service)], check=True)


def show(unit: str, name: str) -> str:
    done = subprocess.run(["systemctl", "show", unit, f"--property={name}", "--value"], capture_output=True, text=True)
    return done.stdout.strip()


class Robot:
    """What it says on its bus."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.state: BalancerState | None = None
        self.fault: BalancerFault | None = None
        self.pose: Pose | None = None
        bus.subscribe("swarm/r0/balancer/*", self._heard)
        bus.subscribe("swarm/r0/dwm/pose", self._heard)

    def _heard(self, key: str, payload: bytes) -> None:
        match key.rsplit("/", 1)[1]:
            case "state":
                self.state = decode(BalancerState, payload, key)
            case "fault":
                self.fault = decode(BalancerFault, payload, key)
            case "pose":
                self.pose = decode(Pose, payload, key)

    @property
    def mode(self) -> str:
        return "" if self.state is None else self.state.mode

    def off(self, x: float, y: float) -> float:
        """How far its pose is from there, m."""
        return math.inf if self.pose is None else math.dist((self.pose.x, self.pose.y), (x, y))

    def said(self) -> str:
        return f"state {self.state}, pose {self.pose}, fault {self.fault}, bus {i2c()}"

    def command(self, mode: str) -> None:
        self._bus.publish("swarm/r0/balancer/set/mode", SetMode(mode))

    def stand(self) -> float:
        """Wherever it is; s it took."""
        again = [0.0]

        def stands() -> bool:
            # Said again: one that lies so that it must be turned over has three tries.
            if self.mode in ("idle", "fault") and time.monotonic() > again[0]:
                self.command("stand")
                again[0] = time.monotonic() + 2.0
            return self.mode == "balancing"

        return wait(stands, "it stands", 40.0)

    def errors(self) -> int:
        assert self.state is not None
        return self.state.bus_errors

    def missed(self) -> int:
        assert self.state is not None
        return self.state.missed

    def fault_is(self, name: str, reason: str) -> bool:
        found = self.fault
        return found is not None and found.name == name and reason in found.reason


def is_a_robot() -> dict[str, float]:
    """What the units promise, on a kernel that can: users, real-time priority, limits, devices."""
    for unit in SERVICES:
        wait(lambda unit=unit: show(unit, "ActiveState") == "active", f"{unit} is up", 60.0)
    up = float(Path("/proc/uptime").read_text().split()[0])
    loop = int(show("swarm-balancer", "MainPID"))
    expect(os.sched_getscheduler(loop) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO, "the loop has no real-time priority")
    status = Path(f"/proc/{loop}/status").read_text()
    expect(int(status.split("VmLck:")[1].split()[0]) > 0, "the loop's memory is not locked")
    for unit, limit in zip(SERVICES, (48, 64, 64, 48), strict=True):
        found = int((group_of(unit) / "memory.max").read_text())
        expect(found == limit << 20, f"{unit} may have {found} bytes")
    tty = Path("/dev/ttyS0").stat()  # of a kernel with udev: the module's, where it is wired to the Pi's UART
    owner, mode = pwd.getpwuid(tty.st_uid).pw_name, stat.S_IMODE(tty.st_mode)
    expect((owner, mode) == ("swarm-dwm", 0o600), f"our udev rule has no effect: ttyS0 is {owner}'s, {mode:o}")
    # The first pose is of few ranges.
    wait(lambda: robot.off(1.0, 1.0) < 0.3, "it knows that it is at (1, 1)")
    return {"up_s": up, "pose_error_m": robot.off(1.0, 1.0)}


def stands() -> dict[str, float]:
    seconds = robot.stand()
    assert robot.state is not None
    ticks, missed = robot.state.ticks, robot.state.missed
    worst, began = 0.0, time.monotonic()
    while time.monotonic() - began < 1.5:
        expect(robot.mode == "balancing", f"it did not stay up: {robot.said()}")
        worst = max(worst, abs(i2c()["tilt"]))
        time.sleep(0.1)
    expect(worst < 0.2, f"it leans by {worst:.2f} rad")
    expect(i2c()["timeout_s"] == 0.02, "the adapter's time-out was not set")
    took = time.monotonic() - began
    return {
        "up_s": seconds,
        "worst_tilt": worst,
        "ticks_hz": (robot.state.ticks - ticks) / took,
        "missed_hz": (robot.state.missed - missed) / took,
    }


def borne(seen: bool, **faults: Any) -> dict[str, float]:
    """A fault that comes and goes: counted where it can be seen, and the robot stays up."""
    robot.stand()
    before = robot.errors()
    i2c(**faults)

    def over() -> bool:
        left = i2c()
        return not (left["sda_held"] or left["faults"]["hold_sda"] or any(sum(left["faults"][name].values()) for name in
            ("nack", "short", "timeout", "corrupt")))  # fmt: skip

    wait(over, "it is over")
    if seen:
        wait(lambda: robot.errors() > before, "it is counted", 5.0)
    began = time.monotonic()
    while time.monotonic() - began < 0.6:
        expect(robot.mode == "balancing", f"it fell: {robot.said()}")
        time.sleep(0.05)
    return {"bus_errors": robot.errors() - before}


def named(reason: str, over: dict[str, Any], **faults: Any) -> dict[str, float]:
    """A fault that stays: the motors are off, it has its name, and nothing moves when it has gone, until a command."""
    robot.stand()
    began = time.monotonic()
    i2c(**faults)
    wait(lambda: i2c()["motors"] == [0.0, 0.0] and robot.mode == "fault", "the motors are off", 10.0)
    off = time.monotonic() - began
    wait(lambda: robot.fault_is("bus", reason), f"the fault is named: {reason}", 5.0)
    i2c(**over)
    time.sleep(0.8)
    expect(robot.mode == "fault" and i2c()["motors"] == [0.0, 0.0], f"it moves by itself: {robot.said()}")
    return {"off_s": off, "up_again_s": robot.stand()}


def another_device() -> dict[str, float]:
    """What answers is no LSM6DS33, as a cable that garbles every byte would have it."""
    robot.stand()
    i2c(stuck=True)
    wait(lambda: robot.mode == "fault", "the bus is found dead", 10.0)
    i2c(stuck=False, corrupt={imu.ADDRESS: FOR_GOOD})
    robot.command("rest")
    wait(lambda: robot.fault_is("device", "WHO_AM_I is 0x96, expected 0x69"), "the wrong device is named", 10.0)
    i2c(corrupt={})
    return {"up_again_s": robot.stand()}


def killed() -> dict[str, float]:
    """The loop, in the middle of standing: the ATmega stops the motors, systemd brings the loop back, it waits."""
    robot.stand()
    old = show("swarm-balancer", "MainPID")
    crash("balancer")
    off = wait(lambda: i2c()["motors"] == [0.0, 0.0], "the motors are off", 5.0)
    back = wait(lambda: show("swarm-balancer", "MainPID") not in ("0", old), "there is another loop", 20.0)
    robot.state = None
    wait(lambda: robot.mode == "idle", "it is ready again", 30.0)
    return {"off_s": off, "back_s": back, "up_again_s": robot.stand()}


def mesh_killed() -> dict[str, float]:
    """By the live page: the main process is another one, and nothing else was started anew."""
    others = {unit: show(unit, "MainPID") for unit in SERVICES if unit != "swarm-mesh"}
    old, restarts = show("swarm-mesh", "MainPID"), int(show("swarm-mesh", "NRestarts"))
    crash("mesh")
    back = wait(lambda: show("swarm-mesh", "MainPID") not in ("0", old), "there is another mesh", 20.0)
    wait(lambda: show("swarm-mesh", "ActiveState") == "active", "it is up", 30.0)
    expect(int(show("swarm-mesh", "NRestarts")) == restarts + 1, "it was not systemd that started it, once")
    expect(others == {unit: show(unit, "MainPID") for unit in others}, "others were started anew, too")
    return {"back_s": back}


def group_of(unit: str) -> Path:
    """The folder of a service's cgroup. A limit written there below what its processes have ends one of them at once,
    as when it had grown up to its limit; the service that is started anew has that of its unit."""
    return Path("/sys/fs/cgroup") / show(unit, "ControlGroup").strip("/")


def told_in_the_log(unit: str, text: str) -> bool:
    words = ["journalctl", "--no-pager", "--output=cat", f"--unit={unit}"]
    return text in subprocess.run(words, capture_output=True, text=True).stdout


def a_limit_of_memory_is_reached() -> dict[str, float]:
    """That service is ended and started anew, nothing else is, the robot stands, and the log says why."""
    robot.stand()
    subprocess.run(["systemctl", "start", "--no-block", APP], check=True)
    wait(lambda: show(APP, "ActiveState") == "active", f"{APP} has begun", 60.0)
    measured = {}
    for unit in ("swarm-mesh", "swarm-dwm", "swarm-bus", APP):
        group = group_of(unit)
        measured[f"{unit.removeprefix('swarm-')}_mib"] = int((group / "memory.current").read_text()) / (1 << 20)
        others = {other: show(other, "MainPID") for other in SERVICES if other != unit}
        old = show(unit, "MainPID")
        (group / "memory.max").write_text(str(4 << 20))
        wait(lambda unit=unit, old=old: show(unit, "MainPID") not in ("0", old), f"there is another {unit}", 20.0)
        wait(lambda unit=unit: show(unit, "ActiveState") == "active", f"{unit} is up", 30.0)
        wait(lambda unit=unit: told_in_the_log(unit, "oom-kill"), f"the log of {unit} says why", 5.0)
        expect(others == {other: show(other, "MainPID") for other in others}, f"others were started anew with {unit}")
    subprocess.run(["systemctl", "stop", APP], check=True)
    return {**measured, **heard_again()}


def heard_again() -> dict[str, float]:
    """It stands as before. While the kernel looked for what it may end, the machine's only processor may have stood
    still for longer than a body stands without its loop: then there is a named fault, and it stands by command."""
    robot.state = None
    wait(lambda: robot.mode in ("balancing", "fault"), "it is heard again", 20.0)
    expect(robot.mode == "balancing" or robot.fault is not None, f"it fell without a word: {robot.said()}")
    fell = float(robot.mode == "fault")
    return {"fell": fell, "up_again_s": robot.stand()}


HOG = """
import sys
from pathlib import Path
group = Path(sys.argv[1])
Path("/proc/self/oom_score_adj").write_text("-1000")
(group / "cgroup.procs").write_text("0")
taken = []
while "oom_kill 0" in (group / "memory.events").read_text() and len(taken) < 200:
    taken.append(bytearray(b"x") * (1 << 20))
"""
"""Takes memory as a member of a group, until the kernel has ended another process of it."""


def the_balancers_limit_of_memory_is_reached() -> dict[str, float]:
    """Its bridge is ended, and another one started: the loop goes on (on a robot it has a processor of its own)."""
    robot.stand()
    loop = show("swarm-balancer", "MainPID")
    group = group_of("swarm-balancer")

    def bridge() -> list[str]:
        return [pid for pid in (group / "cgroup.procs").read_text().split() if pid != loop]

    old, missed = bridge(), robot.missed()
    current = int((group / "memory.current").read_text())
    subprocess.run([sys.executable, "-c", HOG, str(group)], check=True, timeout=60.0)
    wait(lambda: (now := bridge()) and now != old, "there is another bridge", 10.0)
    expect(show("swarm-balancer", "MainPID") == loop, "the loop was ended")
    heard = heard_again()
    expect(told_in_the_log("swarm-balancer", "the bridge ended code=-9"), "the log does not say so")
    return {"balancer_mib": current / (1 << 20), "missed_ticks": robot.missed() - missed, **heard}


def stopped() -> dict[str, float]:
    """By SIGTERM, in good order: motors off first of all."""
    robot.stand()
    subprocess.run(["systemctl", "stop", "swarm-balancer"], check=True)
    expect(i2c()["motors"] == [0.0, 0.0], "the motors are on")
    expect(show("swarm-balancer", "Result") == "success", "it did not end well")
    refused = subprocess.run(["sh", "-c", kill_command("balancer")], capture_output=True, text=True)
    expect(refused.returncode == 1 and "not running at this moment" in refused.stderr, f"killed what is not: {refused}")
    return {}


IMU, ATMEGA = imu.ADDRESS, balboa.ADDRESS
CHECKS: dict[str, Callable[[], dict[str, float]]] = {
    "is a robot": is_a_robot,
    "stands": stands,
    "IMU does not acknowledge once": lambda: borne(True, nack={IMU: 1}),
    "ATmega does not acknowledge once": lambda: borne(True, nack={ATMEGA: 1}),
    "a transfer ends too early": lambda: borne(True, short={IMU: 1, ATMEGA: 1}),
    "a transfer takes too long": lambda: borne(True, timeout={0: 1}),
    "SDA is held": lambda: borne(True, hold_sda=True),
    "a sample is corrupt": lambda: borne(False, corrupt={IMU: 1}),
    "the encoders are corrupt": lambda: borne(False, corrupt={ATMEGA: 1}),
    "IMU is gone": lambda: named("I2C, IMU: Remote I/O error (error 121)", {"nack": {}}, nack={IMU: FOR_GOOD}),
    "the bus is dead": lambda: named("I2C, ATmega: Connection timed out (error 110)", {"stuck": False}, stuck=True),
    "another device": another_device,
    "killed": killed,
    "mesh is killed": mesh_killed,
    "a limit of memory is reached": a_limit_of_memory_is_reached,
    "the balancer's limit of memory is reached": the_balancers_limit_of_memory_is_reached,
    "stopped": stopped,
}


def main() -> None:
    """All checks, until one fails."""
    for name, check in CHECKS.items():
        problem, measured = "", {}
        began = time.monotonic()
        try:
            measured = check()
        except (CheckFailed, WaitedInVainError) as error:
            problem = str(error)
        except (OSError, LookupError, ValueError, TypeError, AssertionError):  # a check of ours is wrong
            problem = traceback.format_exc()
        if problem:
            words = ["journalctl", "--no-pager", "--lines=40", "--unit=swarm-*", "--output=short-monotonic"]
            problem += "\n" + subprocess.run(words, capture_output=True, text=True).stdout
        measured["took_s"] = time.monotonic() - began
        with Path("/share/report").open("a") as file:
            file.write(json.dumps({"check": name, "problem": problem, **measured}) + "\n")
        if problem:  # what follows would wait for a robot that is not well
            return


if __name__ == "__main__":
    with Bus.of(Path("/run/swarm")) as connection:
        if not connection.wait_connected(30.0):
            sys.exit("there is no bus")
        robot = Robot(connection)
        main()
