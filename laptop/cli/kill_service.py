"""`swarm hand kill ROBOT SERVICE`: end one service of a running simulation, which starts it again as systemd would."""

import os
import signal
from pathlib import Path

from laptop.fleet.units import SERVICES
from swarm.errors import LocalError
from swarm.messages.keys import is_name
from swarm.process.simulations import pid_of

SIGNALS = ("KILL", "TERM", "STOP", "CONT")


def end(runtime: Path, wanted: str, name: str) -> tuple[str, int]:
    """Send the signal `name` to a service of the robot with this runtime directory; the service's full name, and its
    pid. Raises `LocalError` where there is none."""
    service = _service(runtime, wanted)
    pid = pid_of(runtime.parent, runtime.name, service)
    if pid is None or not _send(pid, runtime, getattr(signal, f"SIG{name}")):
        raise LocalError(f"{service} of {runtime.name} is not running at this moment")
    return service, pid


def _service(runtime: Path, wanted: str) -> str:
    """The service's full name; a robot runs one app as a rule, then `app` alone will do."""
    name = wanted.removeprefix("app/")
    if wanted in SERVICES or (wanted.startswith("app/") and is_name(name)):
        return wanted
    apps = sorted(path.name.removesuffix(".pid").replace(".", "/", 1) for path in runtime.glob("app.*.pid"))
    if wanted != "app":
        raise LocalError(f"no service {wanted!r}; there are {', '.join([*SERVICES, *apps])}")
    if len(apps) != 1:
        raise LocalError(f"expected app/NAME: {runtime.name} runs {', '.join(apps) or 'no app'}")
    return apps[0]


def _send(pid: int, runtime: Path, number: signal.Signals) -> bool:
    """Send the signal if `pid` is still that robot's process. The descriptor holds on to it while we look."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return False
    try:
        if not _belongs_to(pid, runtime):
            return False
        signal.pidfd_send_signal(descriptor, number)
    except ProcessLookupError:
        return False
    finally:
        os.close(descriptor)
    return True


def _belongs_to(pid: int, runtime: Path) -> bool:
    """Whether the process was started as a service of the robot with this runtime directory."""
    try:
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False
    own = {os.fsencode(f"SWARM_RUNTIME={path}") for path in (runtime, runtime.resolve())}
    return not own.isdisjoint(variables)
