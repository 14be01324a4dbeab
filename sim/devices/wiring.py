"""A simulated robot put together, without what balances it: its body and devices, and what they are wired to."""

import contextlib
import os
import random
from collections.abc import Callable
from pathlib import Path

from services.balancer.core.control.body import body_model
from sim.core.balboa import REST_TILT, BalboaBody
from sim.core.devices import SimulatedRobot, draw_errors
from sim.core.module_line import SOURCE, TTY, ModuleLine
from sim.devices.i2c import SimulatedBus
from sim.devices.world_client import WorldClient
from swarm import clock
from swarm.config import Config
from swarm.errors import LocalError
from swarm.process.paths import runtime_dir

RETRY_S = 1.0
"""Seconds between two attempts to find the module."""


class ModuleWire:
    """The serial line between the simulated ATmega and the world's DWM1001, a pseudo-terminal."""

    def __init__(self, line: Callable[[], ModuleLine], path: Path) -> None:
        """`line` gives the ATmega's end of the line, which is a new one after each reset."""
        self._line, self._path = line, path
        self._terminal: int | None = None
        self._try_at = 0.0

    def carry(self, now: float) -> None:
        """Carry bytes in both directions. Bytes without a reader at the other end are lost, as on a wire."""
        if self._terminal is None:
            self._open(now)
        request = self._line().to_send()
        if self._terminal is None:
            return
        try:
            if request:
                os.write(self._terminal, request)
            if data := os.read(self._terminal, 4096):
                self._line().receive(data, now)
        except BlockingIOError:
            return
        except OSError:  # the module was unplugged
            os.close(self._terminal)
            self._terminal = None

    def _open(self, now: float) -> None:
        if now < self._try_at:
            return
        self._try_at = now + RETRY_S
        with contextlib.suppress(OSError):
            self._terminal = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


def lying() -> int:
    """Return 1 where robots begin on their front, -1 on their back, 0 where they stand up by themselves."""
    text = os.environ.get("SWARM_SIM_LYING", "")
    sides = {"": 0, "front": 1, "back": -1}
    if text not in sides:
        raise LocalError(f"SWARM_SIM_LYING={text!r}: expected front or back")
    return sides[text]


def _devices(config: Config, robot: str, body: BalboaBody, noise: random.Random) -> SimulatedRobot:
    """Return the devices of a robot, with the values that [simulation] gives them."""
    measured, errors = config.simulation, draw_errors(noise)
    if measured.gyro_noise is not None:
        errors = errors._replace(gyro_noise=measured.gyro_noise)
    if measured.acceleration_noise is not None:
        errors = errors._replace(acceleration_noise=measured.acceleration_noise)
    devices = SimulatedRobot(body, noise, errors=errors, trim=config.body_of(robot).trim)
    if measured.battery is not None:
        devices.atmega.battery = measured.battery
    devices.scl = 1e3 * config.robot(robot).i2c_clock if measured.scl is None else measured.scl
    return devices


def simulated_bus(config: Config, robot: str) -> SimulatedBus:
    """Return the bus of a robot that stands at its place of the config, held upright until its motors start. Where
    an earlier process of its balancer ended, it lies where it fell."""
    text = os.environ.get("SWARM_SEED", "0")
    if not text.lstrip("-").isdecimal():
        raise LocalError(f"SWARM_SEED={text!r}: expected an integer")
    noise = random.Random(f"{text} {robot}")
    shape = config.body_of(robot)
    place = config.simulation.places.get(robot, (0.0, 0.0, 0.0))
    body = BalboaBody(body_model(config.robot(robot).board, shape), clock.now(), place=place)
    if side := lying():
        body.put_down(*place, side * REST_TILT)
    devices = _devices(config, robot, body, noise)
    wires: list[Callable[[float], None]] = [WorldClient(robot, devices, runtime_dir(), clock.now()).look]
    if config.dwm.source == SOURCE:
        wires.append(ModuleWire(lambda: devices.atmega.line, runtime_dir() / TTY).carry)

    def transferred(now: float) -> None:
        for wire in wires:
            wire(now)

    return SimulatedBus(devices, clock.now, transferred)
