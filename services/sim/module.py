"""Simulated DWM1001 modules: each answers at a pseudo-terminal, byte for byte as a real one at a port.

The dwm service opens `RUN/<robot>/dwm.tty` with pyserial and cannot tell the difference. All modules of a run
hang on one selector: let `ModuleBoard.poll` run in a loop, or wait on `fileno()` until `next_deadline()` in a
loop of your own.
"""

import contextlib
import os
import random
import selectors
import tty
from collections import deque
from pathlib import Path

from services.dwm.core.tlv import LOC_GET, Location, Position, encode_location, encode_refusal
from services.sim.core.module_line import TTY
from services.sim.core.uwb import PERIOD, Module, Tag
from swarm import clock
from swarm.config import Config

LATENCY = (0.010, 0.030)
"""s from request to answer, uniform between these."""

REQUEST_GAP = 0.05
"""s of silence after which half a request is given up. The real module does it after 763 us, which a
scheduler on a busy machine would not keep."""

_UNKNOWN_CALL = 1


def modules_of(config: Config) -> list[Module]:
    """The modules in the simulated room: the configured anchors, and the target where the simulation put it.

    The target takes part in the tags' positioning only where it is configured as an anchor too.
    """
    known = {anchor.address: anchor for anchor in config.anchors}
    places = {anchor.address: (anchor.x, anchor.y, anchor.z) for anchor in config.anchors}
    target = config.dwm.target
    if target is not None:
        places[target] = (*config.simulation.target, known[target].z if target in known else 0.0)
    nowhere = Position(0.0, 0.0, 0.0, 0)
    return [
        Module(
            address,
            *place,
            Position(known[address].x, known[address].y, known[address].z, 100) if address in known else nowhere,
        )
        for address, place in places.items()
    ]


class SimulatedModule:
    """One tag and its pseudo-terminal.

    It holds the terminal's far end open too, as the wire to a real module stays when the program at the other
    end goes: the process that opened it may close it, die of kill -9 and open it again, and we never see an
    error.
    """

    def __init__(self, path: Path, tag: Tag, generator: random.Random, now: float) -> None:
        self.path = path
        self.pose: tuple[float, float, float] | None = None
        self._tag = tag
        self._generator = generator
        self._measure_at = now + generator.uniform(0.0, PERIOD)
        self._location = Location(Position(0.0, 0.0, 0.0, 0), ())
        self._request = bytearray()
        self._request_by = 0.0
        self._answers: deque[tuple[float, bytes]] = deque()
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._far))

    def fileno(self) -> int:
        """Readable when there is something for `receive`."""
        return self._near

    def next_deadline(self) -> float:
        """When to call `handle_timer` next."""
        deadline = min(self._measure_at, self._answers[0][0] if self._answers else self._measure_at)
        return min(deadline, self._request_by) if self._request else deadline

    def handle_timer(self, now: float) -> None:
        """Measure, and answer, when it is time to."""
        if now >= self._measure_at:
            if self.pose is not None:
                self._location = self._tag.measure(*self.pose)
            self._measure_at += PERIOD
            if self._measure_at <= now:  # we were late: measurements do not queue up
                self._measure_at = now + PERIOD
        if self._request and now >= self._request_by:
            self._request.clear()
            self._answer(encode_refusal(_UNKNOWN_CALL), now)
        while self._answers and now >= self._answers[0][0]:
            with contextlib.suppress(BlockingIOError):  # nobody reads: a wire would lose the bytes too
                os.write(self._near, self._answers.popleft()[1])

    def receive(self, now: float) -> None:
        """Read what the robot sent; a request may come in pieces."""
        try:
            self._request += os.read(self._near, 4096)
        except BlockingIOError:
            return
        self._request_by = now + REQUEST_GAP
        while len(self._request) >= 2 and len(self._request) >= (end := 2 + self._request[1]):
            request = bytes(self._request[:end])
            del self._request[:end]
            known = request == LOC_GET.request
            self._answer(encode_location(self._location) if known else encode_refusal(_UNKNOWN_CALL), now)

    def close(self) -> None:
        """Take the module off the wire: the robot's end reports an error from now on."""
        self.path.unlink(missing_ok=True)
        os.close(self._near)
        os.close(self._far)

    def _answer(self, data: bytes, now: float) -> None:
        self._answers.append((now + self._generator.uniform(*LATENCY), data))


class ModuleBoard:
    """The modules of all robots of a run."""

    def __init__(self, run_dir: Path, config: Config, seed: int) -> None:
        self._run_dir = run_dir
        self._places = config.simulation.places
        self._around = modules_of(config)
        self._seed = seed
        self._modules: dict[str, SimulatedModule] = {}
        self._selector = selectors.EpollSelector()

    def add(self, robot: str) -> None:
        """Wire a module to `robot`, at its starting place where the config gives one; else it sees nothing
        yet."""
        # One generator for what is measured and one for when, so that the measurements depend on the seed
        # alone.
        tag = Tag(self._around, random.Random(f"{self._seed} {robot} uwb"))
        directory = self._run_dir / robot
        directory.mkdir(parents=True, exist_ok=True)
        timing = random.Random(f"{self._seed} {robot} latency")
        module = SimulatedModule(directory / TTY, tag, timing, clock.now())
        module.pose = self._places.get(robot)
        self._modules[robot] = module
        self._selector.register(module, selectors.EVENT_READ, module)

    def remove(self, robot: str) -> None:
        """Unplug the module of `robot`."""
        module = self._modules.pop(robot)
        self._selector.unregister(module)
        module.close()

    def update_pose(self, robot: str, x: float, y: float, heading: float) -> None:
        """Where `robot` is now (m, rad); may be called from another thread."""
        self._modules[robot].pose = (x, y, heading)

    def fileno(self) -> int:
        """Readable when `poll` has something to read."""
        return self._selector.fileno()

    def next_deadline(self) -> float:
        """When `poll` has something to do without anything to read; infinity without modules."""
        return min((module.next_deadline() for module in self._modules.values()), default=float("inf"))

    def poll(self, timeout: float) -> None:
        """Do what is to be done, waiting at most `timeout` seconds for the first thing."""
        wait = max(0.0, min(timeout, self.next_deadline() - clock.now()))
        for key, _ in self._selector.select(wait):
            key.data.receive(clock.now())
        now = clock.now()
        for module in self._modules.values():
            if now >= module.next_deadline():
                module.handle_timer(now)

    def close(self) -> None:
        """Unplug all modules."""
        for robot in list(self._modules):
            self.remove(robot)
        self._selector.close()
