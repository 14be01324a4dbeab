"""Simulations that run on this machine, and how to find one.

A simulation lives in a run directory: one subdirectory per robot, which is that robot's runtime directory,
and `swarm.toml`. Its parent process holds a lock on `sim.lock` for as long as it lives, however it ends; the
file itself stays and says nothing.
"""

import os
import time
from pathlib import Path

from swarm.config import Config, load
from swarm.config.toml_input import read_toml
from swarm.errors import BusError, LocalError, PayloadError
from swarm.messages.keys import is_name
from swarm.process.locks import is_held, take_lock
from swarm.process.paths import BUS_SOCKET

LOCK = "sim.lock"
CONFIG = "swarm.toml"
_ATTEMPTS = 20


HAS_PROCESSES = hasattr(os, "eventfd")
"""Whether this system can run the processes of robots: what they wait with only Linux has."""
_LINUX = "this command needs Linux (on Windows: WSL); `swarm sim --virtual` and `swarm.simulate` run everywhere"


def default_run_dir() -> Path:
    """Return the default directory of this user's simulation. It is short, since paths of sockets are limited."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        return Path(runtime) / "swarm-sim"
    if not hasattr(os, "getuid"):
        raise LocalError(_LINUX)
    return Path(f"/tmp/swarm-sim-{os.getuid()}")  # noqa: S108


class _RunLock:
    """The lock on a run directory, held until closed or until the process ends."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def close(self) -> None:
        """Let another simulation have the directory; safe to call twice."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)

    def __enter__(self) -> "_RunLock":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def claim(directory: Path) -> _RunLock:
    """Make `directory` and hold it for one simulation; `BusError` where that cannot be, and `LocalError` on a system
    that cannot run one.

    It is open to its owner alone: whoever reaches the sockets in it drives the robots. Since a simulation clears
    its run directory, one that holds anything but an earlier run is refused.
    """
    if not HAS_PROCESSES:
        raise LocalError(_LINUX)
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        if directory.stat().st_uid != os.getuid():
            raise BusError(f"{directory}: belongs to another user; use --run-dir")
        if not (directory / LOCK).exists() and any(directory.iterdir()):
            raise BusError(f"{directory}: is neither empty nor a run directory; use another --run-dir")
        descriptor = os.open(directory / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise BusError(f"{directory}: no run directory: {error.strerror}; use --run-dir") from None
    if not _lock(descriptor):
        pid = os.pread(descriptor, 32, 0).decode(errors="replace").strip() or "unknown"
        os.close(descriptor)
        raise BusError(f"{directory}: a simulation is already running there (pid {pid}); end it or use --run-dir")
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    return _RunLock(descriptor)


def _lock(descriptor: int) -> bool:
    """Lock, with patience for a moment: somebody may just be looking whether a simulation runs."""
    for _ in range(_ATTEMPTS):
        try:
            take_lock(descriptor)
        except BlockingIOError:
            time.sleep(0.01)
        else:
            return True
    return False


def is_live(directory: Path) -> bool:
    """Return whether a simulation runs in `directory` at this moment."""
    try:
        return is_held(directory / LOCK)
    except OSError:
        return False


def config_for(runtime: Path) -> Config:
    """Return the configuration for the robot with a runtime directory: that of its simulation, on a robot its own."""
    return load(runtime.parent / CONFIG if is_live(runtime.parent) else None)


def robots(directory: Path) -> dict[str, Path]:
    """Runtime directory of each simulated robot: those its config lists, and those whose bus is there."""
    with_bus = {path.parent.name for path in directory.glob(f"*/{BUS_SOCKET}")}
    names = sorted(with_bus | set(_listed(directory / CONFIG)))
    return {name: directory / name for name in names if is_name(name)}


def running(run_dir: Path | None) -> Path:
    """Return the directory of the simulation that runs in `run_dir` (None = the usual place); `LocalError` where none
    does."""
    directory = (run_dir or default_run_dir()).absolute()
    if not is_live(directory):
        raise LocalError(f"no simulation is running in {directory} (--run-dir names another one)")
    return directory


def runtime_of(run_dir: Path | None, robot: str) -> Path:
    """Runtime directory of a robot of the running simulation in `run_dir` (None = the usual place).

    Raises `LocalError` where there is no such simulation or robot.
    """
    directory = running(run_dir)
    known = robots(directory)
    if robot not in known:
        raise LocalError(f"no robot {robot!r} in the simulation, there are {', '.join(known) or 'none yet'}")
    return known[robot]


def _listed(path: Path) -> list[str]:
    """Return the names in a config that may be half written or of another version: only they are looked at."""
    try:
        table = read_toml(path.read_text(encoding="utf-8"))
        return [str(robot["name"]) for robot in table.get("robots", [])]
    except (OSError, PayloadError, ValueError, TypeError, KeyError, AttributeError):
        return []


def pid_file(directory: Path, robot: str, service: str) -> Path:
    """Return the file in which the simulation in `directory` notes the pid of a service (`app/consensus` has a
    slash)."""
    return directory / robot / f"{service.replace('/', '.')}.pid"


def pid_of(directory: Path, robot: str, service: str) -> int | None:
    """Pid of a robot's service as its simulation noted it; None where there is no such note."""
    try:
        pid = int(pid_file(directory, robot, service).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
    return pid if pid > 1 else None
