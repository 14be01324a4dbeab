"""Checks of a robot's computer: its set-up, disk, memory, heat, services, release, config and key."""

from collections.abc import Callable
from pathlib import Path

from laptop.fleet.core import steps
from laptop.fleet.core.checkup import SIMULATED, Check, ExaminedRobot, Finding, bad, ok, skipped, warning
from laptop.fleet.core.wish import DesiredRobot, ProvisioningStep, wish
from swarm.config.types import DEFAULT_KEY_FILE

LOW_DISK = 200_000_000
LOW_MEMORY = 40_000_000
"""Bytes of free memory below which the check warns."""
HOT_C = 75.0
"""Temperature above which the check warns, degrees Celsius: a Pi slows down from 80 on."""
RESTARTS = 3
"""Number of restarts of a service, since it was started by hand, from which on the check warns."""

PROVISION = "swarm provision {robot}"


def _wish(robot: ExaminedRobot) -> DesiredRobot:
    address = robot.config.robot(robot.name).host or robot.name
    return wish(robot.config, robot.name, address, robot.now, key=False, wifi=None)


def _step(step: ProvisioningStep) -> Callable[[ExaminedRobot], Finding]:
    """Make a check of a provisioning step, with the same judgement."""

    def judge(robot: ExaminedRobot) -> Finding:
        verdict = step.judge(robot.facts, _wish(robot))
        if verdict.state == "ok":
            return ok(verdict.text)
        if verdict.state == "change":
            return bad(f"not as it should be: {verdict.text}", PROVISION.format(robot=robot.name))
        return bad(verdict.text, f"mend that, then: {PROVISION.format(robot=robot.name)}")

    return judge


def disk(robot: ExaminedRobot) -> Finding:
    """Check that there is room for recordings and logs."""
    free = robot.disk if robot.system is None else robot.system["free"].get("/")
    if free is None:
        return SIMULATED
    text = f"{free / 1e6:.0f} MB left"
    if free < LOW_DISK:
        return bad(text, "swarm fetch --delete brings the recordings here; then remove what is not needed")
    return ok(text)


def memory(robot: ExaminedRobot) -> Finding:
    """Check that there is memory for one more app."""
    free = robot.facts["memory"]
    if free is None:
        return warning("it does not tell", "look at /proc/meminfo there")
    text = f"{free / 1e6:.0f} MB to be had"
    if free < LOW_MEMORY:
        return warning(
            text, "stop apps that are not needed: swarm services stop APP; what takes it: swarm command 'ps aux'"
        )
    return ok(text)


_NOW = {0: "too little voltage", 1: "slowed down", 2: "throttled", 3: "at its limit of heat"}
"""Bits of get_throttled about the present. The same bits, 16 places higher, are about the time since power-on."""


def heat(robot: ExaminedRobot) -> Finding:
    """Check that the Pi is neither hot nor short of voltage."""
    celsius, flags = robot.facts["temperature"], robot.facts["throttled"] or 0
    text = "no temperature" if celsius is None else f"{celsius:.0f} degrees"
    now = [word for bit, word in _NOW.items() if flags >> bit & 1]
    past = [word for bit, word in _NOW.items() if flags >> (bit + 16) & 1]
    if "too little voltage" in now:
        return bad(f"{text}, {', '.join(now)}", "charge the batteries; look at the cable from the Balboa's regulator")
    if now or (celsius or 0) > HOT_C:
        return warning(", ".join([text, *now]), "give it air; stop apps that compute without need")
    if past:
        return warning(f"{text}; since it was switched on: {', '.join(past)}", "batteries or heat were at their limit")
    return ok(text)


def services(robot: ExaminedRobot) -> Finding:
    """Check that all services run, and that none starts again and again."""
    if robot.system is None:
        if robot.bus is None or not robot.bus.get("bus"):
            return bad("its bus does not answer", "is the simulation running?")
        silent = [name for name in ("mesh", "balancer", "dwm") if not robot.said(f"{name}/status")]
        if silent:
            return bad(f"no word from {' '.join(silent)}", "what it says is in the simulation's log; is it stopped?")
        return ok("all of them answer")
    found = robot.system["services"]
    down = [
        f"{name.removeprefix('swarm-')} ({each.get('Result', '?')})"
        for name, each in found.items()
        if each.get("ActiveState") != "active"
    ]
    if any(each.get("LoadState") == "not-found" for each in found.values()):
        return bad("there are none", "install a release: swarm provision, or swarm deploy")
    if down:
        return bad(f"not running: {' '.join(down)}", "why: swarm logs; then: swarm services restart")
    if robot.bus is not None and not robot.bus.get("bus"):
        return bad("they run, and the bus does not answer", "swarm logs bus; then: swarm services restart bus")
    often = [name.removeprefix("swarm-") for name, each in found.items() if int(each.get("NRestarts") or 0) >= RESTARTS]
    if often:
        return warning(f"started again and again: {' '.join(often)}", f"why: swarm logs {often[0]}")
    return ok("all run")


def release(robot: ExaminedRobot) -> Finding:
    """Check that a release is installed."""
    current = robot.facts["current"]
    if not current:
        return bad("no release is installed", "swarm provision, or swarm deploy")
    return ok(str(current))


def config(robot: ExaminedRobot) -> Finding:
    """Check that the robot has our swarm.toml, and knows which robot it is."""
    if robot.facts["config"] is None:
        return bad("it has no /etc/swarm/swarm.toml", "swarm deploy")
    if robot.facts["robot"] != robot.name:
        return bad(f"it takes itself for {robot.facts['robot']}", "swarm deploy, or mend `host` in swarm.toml")
    if robot.facts["config"] != robot.digest:
        return bad(f"its swarm.toml is not {robot.config.path}", "swarm deploy brings this one")
    return ok("the same as here")


def key(robot: ExaminedRobot) -> Finding:
    """Check that nobody but the mesh can read the key."""
    path = robot.config.mesh.key_file
    if path is None:
        return skipped("swarm.toml says insecure: links need none")
    by_deploy = path == Path(DEFAULT_KEY_FILE)
    bring = "swarm deploy --key FILE (swarm key new makes one)" if by_deploy else f"copy the key to {path} there"
    if robot.key is None:
        return bad("it has no key", bring)
    mode = int(str(robot.key["mode"]), 8)
    if mode & 0o077:
        return bad(
            f"others may read it (mode {mode:04o})",
            f"chmod 600 {path} there; if others had access: a new key, swarm key rotate",
        )
    if robot.system is not None and robot.key["owner"] != "swarm-mesh":
        return bad(f"it belongs to {robot.key['owner']}", f"chown swarm-mesh {path} there")
    if not robot.key["ids"]:
        return bad("there is no key in the file", bring)
    return ok(f"mode {mode:04o}, id {' '.join(robot.key['ids'])}")


_SETUP = {
    "board": "the board is the one that swarm.toml says",
    "system": "Raspberry Pi OS Lite, 64 bit, Bookworm or Trixie",
    "packages": "bluez, python3-venv, python3-bluez and rfkill are installed",
    "kernel": "a kernel of 6.12 or later runs",
    "boot": "config.txt: I2C on at its clock, which is fixed, the UART where the module is wired to it",
    "cmdline": "cmdline.txt: limits of memory, a core for the balancer",
    "i2c": "i2c-dev is loaded on boot",
    "radio": "the Bluetooth firmware of a Zero 2 W is in its place",
    "bluetooth": "bluetoothd runs on boot, the radio is not blocked",
    "realtime": "real-time limits for the group swarm",
    "network": "Wi-Fi does not sleep",
    "name": "the host's name is the robot's",
    "clock": "the clock is right",
}

CHECKS = (
    *(Check(step.name, _SETUP[step.name], _step(step)) for step in (*steps.FIRST, *steps.THEN) if step.name in _SETUP),
    Check("disk", "there is room on the disk", disk),
    Check("memory", "there is memory for one more app", memory),
    Check("heat", "the Pi is neither hot nor short of voltage", heat),
    Check("release", "a release is installed", release),
    Check("config", "the robot has this swarm.toml and knows its name", config),
    Check("key", "the swarm's key is there, and the mesh's alone", key),
    Check("services", "all services run, and none starts again and again", services),
)
