"""Simulated DWM1001 modules: each speaks at a pseudo-terminal, byte for byte as a real one at a port.

The dwm service opens `RUN/<robot>/dwm.tty` with pyserial and cannot tell the difference; the anchors and the target are
at `RUN/anchors/<address>.tty`, as a laptop would be wired to them. All modules of a run hang on one selector: let
`ModuleBoard.poll` run in a loop, or wait on `fileno()` until `next_deadline()` in a loop of your own.
"""

import contextlib
import math
import os
import random
import selectors
import tty
from pathlib import Path

from services.dwm.core.module.calls import Settings
from services.dwm.core.module.tlv import NOWHERE, Location, Position
from sim.core.dwm1001 import Dwm1001, Flash
from sim.core.module_line import TTY, module_address
from sim.core.uwb import Module, Tag, error_model
from swarm import clock
from swarm.config import Config

ANCHORS = "anchors"

_IDENTITY = 0xDECA9AABC0A2 << 16
_MOTION = 0.01
"""Smallest motion, m or rad, that the accelerometer of a simulated module notices [estimated]."""


class SimulatedModule:
    """One module and its pseudo-terminal.

    It holds the terminal's far end open too, as the wire to a real module stays when the program at the other end goes:
    the process that opened it may close it, die of kill -9 and open it again, and we never see an error.
    """

    def __init__(self, path: Path, module: Dwm1001) -> None:
        self.path = path
        self.module = module
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._far))

    def fileno(self) -> int:
        """Return a descriptor that is readable when there is something for `receive`."""
        return self._near

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        self.module.handle_timer(now)
        if data := self.module.to_send(now):
            with contextlib.suppress(BlockingIOError):  # nobody reads: a wire would lose the bytes too
                os.write(self._near, data)

    def receive(self, now: float) -> None:
        """Read the bytes that came over the line."""
        with contextlib.suppress(BlockingIOError):
            self.module.receive(os.read(self._near, 4096), now)

    def close(self) -> None:
        """Take the module off the wire: the other end reports an error from now on."""
        self.path.unlink(missing_ok=True)
        os.close(self._near)
        os.close(self._far)


class ModuleBoard:
    """The modules of all robots of a run, of the anchors and of the target."""

    def __init__(self, run_dir: Path, config: Config, seed: int) -> None:
        self._run_dir = run_dir
        self._config = config
        self._seed = seed
        self._modules: dict[str, SimulatedModule] = {}
        """The modules by robot, or by the address of a module that stands by itself."""
        self._places: dict[str, tuple[float, float, float, float]] = {}
        """The place of each module: x, y, z in m, heading in rad."""
        self._selector = selectors.EpollSelector()
        self._target = target = config.dwm.target
        self.moves_from = math.inf
        """The time at which the target begins to move, if it does."""
        for anchor in config.anchors:
            at = (anchor.x, anchor.y, anchor.z)
            if anchor.address == target:  # the simulation may have moved it
                at = (*config.simulation.target, anchor.z)
            self._add_anchor(anchor.address, at, Position(anchor.x, anchor.y, anchor.z, 100))
        if target is not None and target not in self._modules:
            self._add_anchor(target, (*config.simulation.target, config.dwm.height), NOWHERE)

    def add(self, robot: str) -> None:
        """Wire a module to `robot`, at its starting place where the config gives one; else it sees nothing yet."""
        known = self._config.robot(robot)
        address = known.uwb or module_address(self._config.names.index(robot))
        flash = Flash(Settings(anchor=known.uwb_role == "anchor"))
        place = self._config.simulation.places.get(robot)
        if place is not None:
            self._places[robot] = (place[0], place[1], self._config.dwm.height, place[2])
        self._add(robot, self._run_dir / robot / TTY, address, flash)

    def remove(self, name: str) -> None:
        """Unplug the module of a robot, or an anchor by its address."""
        module = self._modules.pop(name)
        self._selector.unregister(module)
        module.close()

    def module(self, name: str) -> Dwm1001:
        """Return the module of a robot, or an anchor's by its address."""
        return self._modules[name].module

    def update_pose(self, robot: str, x: float, y: float, heading: float) -> None:
        """Set the place of `robot` (m, rad); may be called from another thread."""
        before = self._places.get(robot)
        self._places[robot] = (x, y, self._config.dwm.height, heading)
        if before is None or math.dist(before[:2], (x, y)) > _MOTION or abs(heading - before[3]) > _MOTION:
            self._modules[robot].module.moved(clock.now())

    def fileno(self) -> int:
        """Return a descriptor that is readable when `poll` has something to read."""
        return self._selector.fileno()

    def next_deadline(self) -> float:
        """Return when `poll` has something to do without anything to read; infinity without modules."""
        return min((each.module.next_deadline() for each in tuple(self._modules.values())), default=float("inf"))

    def poll(self, timeout: float) -> None:
        """Do what is to be done, waiting at most `timeout` seconds for the first thing."""
        wait = max(0.0, min(timeout, self.next_deadline() - clock.now()))
        for key, _ in self._selector.select(wait):
            key.data.receive(clock.now())
        now = clock.now()
        for each in tuple(self._modules.values()):
            if now >= each.module.next_deadline():
                each.handle_timer(now)

    def close(self) -> None:
        for name in list(self._modules):
            self.remove(name)
        self._selector.close()

    def _add_anchor(self, address: str, at: tuple[float, float, float], known: Position) -> None:
        self._places[address] = (*at, 0.0)
        initiator = not self._modules  # the first one starts the network
        flash = Flash(Settings(anchor=True, initiator=initiator), place=known)
        self._add(address, self._run_dir / ANCHORS / f"{address}.tty", address, flash)

    def _add(self, name: str, path: Path, address: str, flash: Flash) -> None:
        # One generator for what is measured and one for when, so that the measurements depend on the seed alone.
        tag = Tag(random.Random(f"{self._seed} {name} uwb"), error_model(self._config.simulation.range_noise))
        timing = random.Random(f"{self._seed} {name} latency")
        core = Dwm1001(_IDENTITY | int(address, 16), flash, timing, lambda: self._measure(name, tag), clock.now())
        module = self._modules[name] = SimulatedModule(path, core)
        self._selector.register(module, selectors.EVENT_READ, module)

    def _measure(self, name: str, tag: Tag) -> Location:
        """Return what the module called `name` measures at its place, to all modules that are anchors now."""
        if name not in self._places:
            return Location(NOWHERE, ())
        now = clock.now()
        if self._config.simulation.moving and self._target is not None:
            place = self._config.simulation.target_after(now - self.moves_from)
            self._places[self._target] = (*place, *self._places[self._target][2:])
        around = [
            Module(each.module.address, *self._places[other][:3], each.module.flash.place)
            for other, each in tuple(self._modules.items())
            if other != name and other in self._places and each.module.is_ranged(now)
        ]
        x, y, z, heading = self._places[name]
        return tag.measure(around, x, y, heading, z)
