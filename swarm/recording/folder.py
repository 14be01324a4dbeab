"""The folder of a run: recordings beside what is needed to run it again.

    run.toml              app, run, version, seed, digest: the same on every robot
    swarm.toml            the configuration it ran with
    command.txt           the command that repeats it, of a simulation
    outcome.json          what came out of a simulation of real processes
    <app>.py              the app's source, where it is a file of the author's
    <robot>.<app>.mcap    what that robot's process of the app recorded

The names do not clash when the folders of several robots are copied into one.
"""

import json
from collections.abc import Mapping
from pathlib import Path

from swarm import __version__
from swarm.config import Config, parse
from swarm.config.toml_input import read_toml
from swarm.errors import LocalError, PayloadError, RecordingError, SwarmError
from swarm.files import atomic_write, make_folder
from swarm.messages.json_input import read_json
from swarm.process.locks import folder_lock
from swarm.process.paths import state_dir

RUN_FILE = "run.toml"
CONFIG_FILE = "swarm.toml"
OUTCOME_FILE = "outcome.json"
KEYS = ("app", "run", "version", "seed", "digest")
"""The keys of `run.toml`."""


def root() -> Path:
    """Return the directory in which a robot keeps a folder for each run."""
    return state_dir() / "runs"


def of_robot(app: str, run: int) -> Path:
    """Return the folder of a run's recording on a robot."""
    return root() / f"{app}-{run:016x}"


def make_empty(folder: Path) -> None:
    """Make the folder of `--record`. Raises `LocalError` where something is in it: recordings are never written over,
    since a run's data may be all there is of an experiment."""
    folder.mkdir(parents=True, exist_ok=True)
    if next(folder.iterdir(), None) is not None:
        raise LocalError(f"--record {folder}: the folder is not empty; name a new one")


def describe(app: str, run: int, seed: int, digest: bytes) -> dict[str, str]:
    """Return the metadata of a run; `digest` is of the app's source."""
    return {"app": app, "run": f"{run:016x}", "version": __version__, "seed": str(seed), "digest": digest.hex()}


def begin(folder: Path, run: Mapping[str, str], files: Mapping[str, bytes]) -> None:
    """Make the folder, with `run` and copies of `files` (by the name they get) in it. What is there already is the
    same: another robot of the simulation has written it. Raises `OSError`."""
    make_folder(folder)
    text = "".join(f"{name} = {json.dumps(value)}\n" for name, value in run.items())  # a JSON text is one of TOML
    with folder_lock(folder):
        for name, data in {**files, RUN_FILE: text.encode()}.items():
            if not (folder / name).exists():
                atomic_write(folder / name, data)


def read_run(folder: Path) -> dict[str, str]:
    """Return what `begin` wrote; empty where the file is missing. Raises `RecordingError`."""
    try:
        text = (folder / RUN_FILE).read_text(encoding="utf-8")
        return {name: str(value) for name, value in read_toml(text).items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, PayloadError) as error:
        raise RecordingError(f"{folder / RUN_FILE}: {error}") from None


def keep_outcome(folder: Path, outcome: Mapping[str, str]) -> None:
    """Write what came out of a run whose recordings belong to processes that have ended. Raises `OSError`."""
    atomic_write(folder / OUTCOME_FILE, json.dumps(outcome, indent=1).encode() + b"\n")


def read_outcome(folder: Path) -> dict[str, str]:
    """Return what `keep_outcome` wrote; empty where the file is missing. Raises `RecordingError`."""
    path = folder / OUTCOME_FILE
    try:
        found = read_json(path.read_bytes()) if path.is_file() else {}
    except (OSError, PayloadError) as error:
        raise RecordingError(f"{path}: {error}") from None
    if not isinstance(found, dict) or not all(isinstance(value, str) for value in found.values()):
        raise RecordingError(f"{path}: expected an object of texts")
    return found


def config_in(folder: Path) -> Config | None:
    """Return the configuration of a run; None where there is none that can be read, as one of another version."""
    path = folder / CONFIG_FILE
    try:
        return parse(path.read_text(encoding="utf-8"), path)
    except (OSError, SwarmError):
        return None
