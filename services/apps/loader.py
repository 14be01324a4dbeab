"""Find an app by its built-in name or its file, and make the instance that runs on one robot.

Every fault of an app file is one message with file and line: the author reads it before any robot moves.
"""

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

from services.apps.runner import describe
from swarm.app.event_app import EventApp, PeriodicApp, channels_of
from swarm.app.robot import Robot
from swarm.app.sync_app import BaseApp as AnyApp
from swarm.app.sync_app import SyncApp
from swarm.config import Config
from swarm.errors import AppError
from swarm.frozen import frozen
from swarm.messages.codec import Value
from swarm.messages.keys import is_name

KINDS = " or ".join(kind.__name__ for kind in (SyncApp, EventApp, PeriodicApp))
"""What an app may be derived from, in words."""

BUILT_IN = (
    "consensus",
    "flooding_demo",
    "formation",
    "goto",
    "led_sync",
    "localization",
    "stand_up",
    "unicast_demo",
)
"""Modules of `services.apps` that are apps."""


@frozen
class LoadedApp:
    """An app that was found: one class, or one for each algorithm."""

    name: str
    """Name on the bus and in swarm.toml: the built-in name, or the file's name without `.py`."""
    source: str
    """Path of its file."""
    algorithms: Mapping[str, type[AnyApp]]
    """By name, the default one first; the only name is empty where there is no choice."""
    digest: bytes
    """Of the source text."""

    def choose(self, values: Mapping[str, Value]) -> tuple[type[AnyApp], dict[str, Value]]:
        """The class that the parameter `algorithm` asks for, and the other parameters."""
        rest = dict(values)
        if "" in self.algorithms:
            return self.algorithms[""], rest
        default = next(iter(self.algorithms))
        algorithm = rest.pop("algorithm", default)
        if not isinstance(algorithm, str) or algorithm not in self.algorithms:
            raise AppError(f"algorithm: expected {' or '.join(map(repr, self.algorithms))}, got {algorithm!r}")
        return self.algorithms[algorithm], rest

    def make(self, config: Config, robot: str, seed: int = 0) -> AnyApp:
        """The instance of one robot, with its parameters of swarm.toml; `AppError` names a wrong entry."""
        known = Robot(robot, config.graph, config.anchors, seed, app=self.name)
        try:
            kind, values = self.choose(config.app(self.name).of(robot))
            return kind(known, values)
        except AppError as error:
            raise AppError(f"app {self.name} on {robot}: {error}") from None

    def check(self, config: Config) -> None:
        """Make the instances of all robots, to find every fault of state and parameters before the swarm
        starts."""
        hashes = {name: type(self.make(config, name)).spec.schema.hash for name in config.names}
        odd = [name for name in hashes if hashes[name] != hashes[config.names[0]]]
        if odd:
            raise AppError(f"app {self.name}: {odd[0]} runs another algorithm than {config.names[0]}")


def load(name_or_file: str) -> LoadedApp:
    """Find an app: a built-in name, or the path of a Python file that defines one."""
    if name_or_file in BUILT_IN:
        module = importlib.import_module(f"services.apps.{name_or_file}")
        return _app(name_or_file, Path(str(module.__file__)), module)
    path = Path(name_or_file)
    if path.suffix != ".py":
        raise AppError(f"there is no app {name_or_file!r}: expected {', '.join(BUILT_IN)}, or a file FILE.py")
    if not path.is_file():
        raise AppError(f"{path}: there is no such file")
    path = path.resolve()
    if not is_name(path.stem):
        raise AppError(
            f"{path}: the file's name is the app's name on the bus: "
            "a lower-case letter, then up to 15 letters, digits, _ or -"
        )
    return _app(path.stem, path, _import(path))


def _import(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"app_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where typing looks up the names in annotations
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))  # as `python FILE.py` has it
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - an app file may raise anything
        raise AppError(f"the app cannot be loaded: {describe(error, str(path))}") from None
    return module


def _app(name: str, path: Path, module: ModuleType) -> LoadedApp:
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(path.parent.glob("*.py")) if path.name == "__init__.py" else [path]:
        digest.update(file.read_bytes())
    found = {
        kind.__name__: kind
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, AnyApp) and kind.__module__ == module.__name__
    }
    # Those that run as channels of another one are none by themselves.
    inner = {declared.kind.__name__ for kind in found.values() for declared in channels_of(kind).values()}
    found = {name: kind for name, kind in found.items() if name not in inner}
    algorithms: Mapping[str, type[AnyApp]]
    if hasattr(module, "ALGORITHMS"):
        algorithms = module.ALGORITHMS
    elif len(found) == 1:
        algorithms = {"": next(iter(found.values()))}
    elif found:
        raise AppError(
            f"{path} defines several apps: {', '.join(sorted(found))}. Leave one in it, or name them: "
            'ALGORITHMS = {"name": Class, ...}, the default first'
        )
    else:
        raise AppError(f"{path} defines no app: expected one class derived from {KINDS} (docs/apps.md)")
    return LoadedApp(name, str(path), algorithms, digest.digest())
