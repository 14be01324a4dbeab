"""The robot inside the booted container: its surroundings, and how checks ask systemd and its bus."""

import json
import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

RIG = Path("/rig")

SIMULATED = RIG / "simulated"
"""What robots do not carry: the simulated body in the place of the real one, and the laptop's questions."""

RUN = Path("/run/rig")

PYTHON = "/opt/swarm/current/bin/python"

SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm")

APP = "swarm-app@restless"

DISK = Path("/var/lib/swarm/runs")
"""Of the recordings."""

RECORDING = DISK / "restless-0000000000000001/r0.restless.mcap"

MODULE = """
import shutil, sys
from pathlib import Path
from typing import Any
from sim.devices.module import ModuleBoard
from swarm.config import load

board = ModuleBoard(Path("/run/rig"), load(), 1)
board.add("r0")
board.update_pose("r0", 1.0, 1.0, 0.0)
shutil.chown(Path("/run/rig/r0/dwm.tty").resolve(), "swarm-dwm")
print("ready", flush=True)
while True:
    board.poll(0.5)
"""
"""The simulated DWM1001 of r0, at a pseudo-terminal that belongs to the dwm service, as udev gives it the real one."""


class CheckFailed(Exception):
    """What a check expected is not so."""


def expect(condition: object, problem: str) -> None:
    if not condition:
        raise CheckFailed(problem)


def sh(*command: str, code: int = 0) -> str:
    """Run a command; its output; `CheckFailed` where its exit code is another."""
    done = subprocess.run(command, capture_output=True, text=True)
    said = done.stdout + done.stderr
    expect(done.returncode == code, f"{' '.join(command)}: exit code {done.returncode}, not {code}: {said[-1500:]}")
    return said


def show(unit: str, *names: str) -> dict[str, str]:
    text = sh("systemctl", "show", unit, *(f"--property={name}" for name in names))
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)


def pid(unit: str) -> int:
    return int(show(unit, "MainPID")["MainPID"])


def wait(condition: Callable[[], object], what: str, seconds: float = 30.0) -> float:
    """s until it was so."""
    began = time.monotonic()
    while not condition():
        expect(time.monotonic() - began < seconds, f"not within {seconds:g} s: {what}")
        time.sleep(0.02)
    return time.monotonic() - began


def ready(unit: str) -> bool:
    return show(unit, "ActiveState")["ActiveState"] == "active"


def ask(program: str) -> str:
    """A few lines of Python on r0's bus."""
    return sh("env", f"PYTHONPATH={SIMULATED}", PYTHON, "-c", program)


def state(topic: str) -> dict[str, Any]:
    """The newest message under a key of r0, as z_sub shows it."""
    lines = sh(
        "/opt/swarm/current/bin/z_sub", f"swarm/r0/{topic}", "--count", "1", "--seconds", "10", "--json"
    ).splitlines()
    expect(lines, f"nothing under swarm/r0/{topic} within 10 s")
    return dict(json.loads(lines[-1])["value"])


def iteration() -> int:
    return int(state("app/restless/progress")["k"])


def ticks() -> tuple[int, int]:
    """Of the balancer since its start: done, and left out for being late."""
    found = state("balancer/state")
    return int(found["ticks"]), int(found["missed"])


STAND = """
from pathlib import Path
from swarm.bus.zenoh_bus import Bus
from swarm.messages import SetMode

with Bus.of(Path("/run/swarm")) as bus:
    bus.wait_connected(10)
    bus.publish("swarm/r0/balancer/set/mode", SetMode("stand"))
"""


def standing() -> bool:
    """Whether it stands. One that fell is told to get up: in a container on a busy machine its loop has no real-time
    priority, and one that comes too late cannot hold a robot."""
    mode = state("balancer/state")["mode"]
    if mode == "fault":
        ask(STAND)
    return bool(mode == "balancing")


# -- the robot's surroundings ------------------------------------------------------------------------------------


def surroundings(phase: str) -> None:
    """The simulated body in the balancer's place, and on the first boot a disk that can be filled."""
    (RUN / "r0").mkdir(parents=True)
    if phase != "install":
        return
    drop_in = Path("/etc/systemd/system/swarm-balancer.service.d/90-rig.conf")
    drop_in.parent.mkdir(exist_ok=True)
    lines = f"Environment=PYTHONPATH={SIMULATED}\nExecStart=\nExecStart={PYTHON} -m sim.body\n"
    drop_in.write_text(f"[Service]\n{lines}")
    # A disk of its own for the recordings, so small that it can be filled.
    DISK.mkdir(parents=True, exist_ok=True)
    sh("mount", "-t", "tmpfs", "-o", "size=96m", "recordings", str(DISK))


def module() -> subprocess.Popen[str]:
    """Start r0's UWB module."""
    environment = {**os.environ, "PYTHONPATH": str(SIMULATED), "SWARM_CONFIG": "/rig/r0.toml", "SWARM_ROBOT": "r0"}
    process = subprocess.Popen([PYTHON, "-c", MODULE], env=environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    expect(process.stdout.readline() == "ready\n", "the simulated module does not start")
    return process


def goes_on() -> None:
    k = iteration()
    wait(lambda: iteration() > k, "the app goes on", 60)


def back_after(signal: str, units: tuple[str, ...], limit: float) -> dict[str, float]:
    """Send all of these units' processes a signal; s until each is back."""
    old = {unit: pid(unit) for unit in units}
    sh("systemctl", "kill", "--kill-whom=main", f"--signal={signal}", *units)
    began, back = time.monotonic(), dict[str, float]()

    def look() -> bool:
        for unit in units:
            if unit not in back and pid(unit) not in (0, old[unit]) and ready(unit):
                back[unit] = time.monotonic() - began
        return len(back) == len(units)

    wait(look, f"{', '.join(units)} back after SIG{signal}", limit)
    return back


def untouched(units: tuple[str, ...], deed: Callable[[], dict[str, float]]) -> dict[str, float]:
    """Do it, while the other services keep their processes; then the app goes on."""
    before = {each: pid(each) for each in (*SERVICES, APP) if each not in units}
    measured = deed()
    expect(before == {each: pid(each) for each in before}, "others were restarted, too")
    goes_on()
    return measured
