"""Programs of ours on a robot that has nothing of ours yet: sent over ssh with each call, run by its own Python.

The command is a bootstrap of a few lines; the first line of its input holds the sources of the modules it may import,
the name of the one to run, and the request. Its output is JSON, one object a line: what it tells on the way, and at
last the result. Nothing is left behind on the robot.
"""

import importlib.util
import json
import shlex
from asyncio import Event
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import swarm
from laptop.fleet.ssh.ssh import ROBOT_REASONS, Host, HostError, Ssh, explained
from swarm.errors import LocalError, PayloadError
from swarm.messages.json_input import read_json

PACKAGE = "swarm.onboard.bootstrap"
_LIBRARY = Path(swarm.__file__).parent
_FOLDER = _LIBRARY / "onboard" / "bootstrap"

BOOT = """
import importlib.abc, importlib.machinery, json, sys
load = json.loads(sys.stdin.buffer.readline())
class Sent(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path, target=None):
        if name in load["modules"]:
            package = any(other.startswith(name + ".") for other in load["modules"])
            return importlib.machinery.ModuleSpec(name, self, origin=name, is_package=package)
    def create_module(self, spec):
        return None
    def exec_module(self, module):
        exec(compile(load["modules"][module.__name__], module.__name__, "exec"), module.__dict__)
def tell(message):
    sys.stdout.write(json.dumps(message) + "\\n")
    sys.stdout.flush()
sys.meta_path.insert(0, Sent())
tell({"result": importlib.import_module(load["main"]).main(load["request"], tell)})
"""

_REASONS = (
    *ROBOT_REASONS,
    ("python3: not found", "it has no python3: flash Raspberry Pi OS Lite, Bookworm or Trixie, 64 bit"),
    ("python3: command not found", "it has no python3: flash Raspberry Pi OS Lite, Bookworm or Trixie, 64 bit"),
    ("No space left on device", "its disk is full: remove what is not needed"),
)  # fmt: skip


_KEPT = 20
"""Last lines without a meaning that are kept for an error: a robot must not fill this computer's memory."""

_WITH_DBUS = ("pairing", "examine")
"""Modules that communicate with bluetoothd."""
_DBUS = ("auth", "bus", "bus_messages", "fds", "low_level", "wrappers", "io.blocking", "io.common")
"""The modules of jeepney that are needed for it."""


def _dbus() -> dict[str, str]:
    """Return the sources of jeepney, by module; they are read and not imported."""
    found = importlib.util.find_spec("jeepney")
    if found is None or found.origin is None:
        raise LocalError("there is no jeepney here, which speaks to bluetoothd: pip install jeepney")
    folder = Path(found.origin).parent
    paths = {f"jeepney.{name}": folder.joinpath(*name.split(".")).with_suffix(".py") for name in _DBUS}
    paths |= {"jeepney": folder / "__init__.py", "jeepney.io": folder / "io" / "__init__.py"}
    return {name: path.read_text() for name, path in paths.items()}


def program(main: str, request: object) -> bytes:
    """Return the first line of the bootstrap's input: module `main` of `swarm.onboard.bootstrap`, and its request."""
    parts = PACKAGE.split(".")
    modules = {".".join(parts[: n + 1]): "" for n in range(len(parts))}
    modules |= {f"{PACKAGE}.{path.stem}": path.read_text() for path in _FOLDER.glob("*.py") if path.stem != "__init__"}
    if main in _WITH_DBUS:
        modules |= _dbus()
    modules["swarm.files"] = (_LIBRARY / "files.py").read_text()
    line = json.dumps({"modules": modules, "main": f"{PACKAGE}.{main}", "request": request})
    return line.encode() + b"\n"


async def call(
    ssh: Ssh,
    host: Host,
    main: str,
    request: object,
    *,
    told: Callable[[dict[str, Any]], None] | None = None,
    until: Event | None = None,
) -> Any:
    """Run a module on a robot, as root, and return what its `main` returns.

    `told` gets what it tells on the way. With `until` the program's input stays open until that is set, or the call is
    cancelled: the program may end by it. Raises `HostError` where it cannot be run or fails.
    """
    results = deque[Any](maxlen=1)
    other = deque[str](maxlen=_KEPT)

    def line(text: str) -> None:
        try:
            message = read_json(text)
        except PayloadError:
            other.append(text)
            return
        if isinstance(message, dict) and "result" in message:
            results.append(message["result"])
        elif isinstance(message, dict) and told is not None:
            told(message)

    command = f"sudo -n python3 -I -c {shlex.quote(BOOT)}"
    done = await ssh.run(host, command, feed=[program(main, request)], on_line=line, hold=until)
    if done.code != 0 or not results:
        problem = explained(done.err or "\n".join(other), _REASONS)
        raise HostError(problem or f"the program ended without a result (exit code {done.code})")
    return results[0]
