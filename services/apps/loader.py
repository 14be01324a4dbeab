"""Find an app by its built-in name or its file, and make the instance that runs on one robot.

Every fault of an app file is one message with file and line: the author reads it before any robot moves.
"""

import hashlib
import importlib
import importlib.util
import inspect
import linecache
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

from services.apps import sources
from services.apps.faults import describe
from swarm import packages
from swarm.app.event_app import EventApp, PeriodicApp, channels_of
from swarm.app.robot import Robot
from swarm.app.sync_app import BaseApp as AnyApp
from swarm.app.sync_app import SyncApp
from swarm.config import Config
from swarm.errors import AppError, LocalError, shown
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
"""Modules of `services.apps.builtin` that are apps."""


@frozen
class LoadedApp:
    """An app that was found: one class, or one for each algorithm."""

    name: str
    """Name on the bus and in swarm.toml: the built-in name, or the file's name without `.py`."""
    source: str
    """Path of its file; of a class out of a notebook what Python calls the cell."""
    algorithms: Mapping[str, type[AnyApp]]
    """The algorithms by name, the default one first; the only name is empty where there is no choice."""
    digest: bytes
    """The digest of the source text of all its files."""

    @property
    def is_built_in(self) -> bool:
        """Whether it is one of ours: an author's own may have the name of one."""
        return Path(self.source).is_relative_to(Path(__file__).parent / "builtin")

    @property
    def text(self) -> bytes:
        """The source text; empty where nobody has kept it, as of a class that was typed at a prompt."""
        path = Path(self.source)
        return path.read_bytes() if path.is_file() else "".join(linecache.getlines(self.source)).encode()

    def choose(self, values: Mapping[str, Value]) -> tuple[type[AnyApp], dict[str, Value]]:
        """Return the class that the parameter `algorithm` asks for, and the other parameters."""
        rest = dict(values)
        if "" in self.algorithms:
            return self.algorithms[""], rest
        default = next(iter(self.algorithms))
        algorithm = rest.pop("algorithm", default)
        if not isinstance(algorithm, str) or algorithm not in self.algorithms:
            raise AppError(f"algorithm: expected {' or '.join(map(repr, self.algorithms))}, got {algorithm!r}")
        return self.algorithms[algorithm], rest

    def kind_on(self, config: Config, robot: str) -> type[AnyApp]:
        """Return the class that runs on a robot, as the configuration chooses it."""
        return self.choose(config.app(self.name).of(robot))[0]

    def make(self, config: Config, robot: str, seed: int = 0) -> AnyApp:
        """Return the instance of one robot, with its parameters of swarm.toml; `AppError` names a wrong entry."""
        known = Robot(robot, config.graph, config.anchors, seed, app=self.name)
        try:
            kind, values = self.choose(config.app(self.name).of(robot))
            return kind(known, values)
        except AppError as error:
            raise AppError(f"app {self.name} on {robot}: {error}") from None
        except LocalError:
            raise
        except (Exception, SystemExit) as error:  # of the author's own methods, such as `neighbour_weights`
            raise AppError(f"app {self.name} on {robot}: {describe(error, self.source)}") from error

    def check(self, config: Config, make: Callable[[Config, str], AnyApp] | None = None) -> None:
        """Make the instances of all robots, to find every fault of state and parameters before the swarm
        starts; `make` in place of the method, where the time that it may take is bounded."""
        make = make or self.make
        hashes = {name: type(make(config, name)).spec.schema.hash for name in config.names}
        odd = [name for name in hashes if hashes[name] != hashes[config.names[0]]]
        if odd:
            first = config.names[0]
            raise AppError(f"app {self.name}: {odd[0]} runs another algorithm than {first}: give all robots the same")


def load(name_or_file: str) -> LoadedApp:
    """Find an app: a built-in name, or the path of a Python file that defines one."""
    if name_or_file in BUILT_IN:
        module = importlib.import_module(f"services.apps.builtin.{name_or_file}")
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


def of_class(kind: type[AnyApp]) -> LoadedApp:
    """Return the app that is one class of a program of its author's: of a script, a test or a notebook's cell.

    Its name is that of the class in small letters with _ between words, at most 16 of them. Raises `AppError` for what
    is no app's class."""
    if not (isinstance(kind, type) and issubclass(kind, AnyApp)):
        raise AppError(f"{kind!r}: expected the name or file of an app, or a class derived from {KINDS}")
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+", kind.__name__)
    name = "_".join(word.lower() for word in words)[:16].rstrip("_")
    functions = [value for value in vars(kind).values() if inspect.isfunction(value)]
    source = functions[0].__code__.co_filename if functions else str(inspect.getmodule(kind))
    found = LoadedApp(name if is_name(name) else "app", source, {"": kind}, b"")
    code = b"".join(function.__code__.co_code for function in functions)
    digest = hashlib.blake2b(found.text or code, digest_size=16).digest()
    return LoadedApp(found.name, source, found.algorithms, digest)


def _import(path: Path) -> ModuleType:
    for file in sources.of_app(path):
        top = path.parent / Path(file).parts[0]
        if top.stem in packages.NAMES:
            raise AppError(packages.rename(top))
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
        relative = isinstance(error, ImportError) and "relative import" in str(error)
        hint = "; a module beside the app's file is imported by its name alone, without a dot" if relative else ""
        raise AppError(f"the app cannot be loaded: {describe(error, str(path))}{hint}") from None
    return module


def _is_entry(entry: tuple[object, object]) -> bool:
    """Return whether an entry of `ALGORITHMS` has a name, and the class of an app."""
    name, kind = entry
    return isinstance(name, str) and name != "" and isinstance(kind, type) and issubclass(kind, AnyApp)


def _app(name: str, path: Path, module: ModuleType) -> LoadedApp:
    # Of one of ours by its folder, since its file imports by whole names; of a user's by what it imports.
    own = {file.name: file.read_bytes() for file in path.parent.glob("*.py")} if path.name == "__init__.py" else None
    digest = sources.digest(own if own is not None else sources.of_app(path))
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
        if not (isinstance(algorithms, Mapping) and algorithms and all(map(_is_entry, algorithms.items()))):
            raise AppError(
                f"{path}: ALGORITHMS: expected the classes of apps (each derived from {KINDS}) by name, the default "
                f'first, as ALGORITHMS = {{"name": Class, ...}}; got {shown(algorithms)}'
            )
    elif len(found) == 1:
        algorithms = {"": next(iter(found.values()))}
    elif found:
        raise AppError(
            f"{path} defines several apps: {', '.join(sorted(found))}. Leave one in it, or name them: "
            'ALGORITHMS = {"name": Class, ...}, the default first'
        )
    else:
        raise AppError(f"{path} defines no app: expected one class derived from {KINDS} (docs/reference/apps.md)")
    return LoadedApp(name, str(path), algorithms, digest)
