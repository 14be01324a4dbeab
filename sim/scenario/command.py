"""The command that repeats a run, which is kept in the folder of its recording."""

import shlex
from collections.abc import Iterable
from pathlib import Path

from swarm.files import atomic_write
from swarm.recording.folder import CONFIG_FILE

COMMAND_FILE = "command.txt"

_RESULTS = {
    "--record": True,
    "--plot": True,
    "--run-dir": True,
    "--speed": True,
    "--json": False,
    "--view": False,
    "--no-open": False,
}
"""Options about results and their display, and whether a value follows."""


def command_of(arguments: Iterable[str]) -> str:
    """Return the command line that repeats a run of `swarm sim ARGUMENTS` in the folder of its recording. The app and
    the configuration are named as their copies there, and options about results are left out."""
    kept, words = [], iter(arguments)
    for word in words:
        option, equals, _ = word.partition("=")
        if option in _RESULTS:
            if _RESULTS[option] and not equals:
                next(words, None)
        elif option == "--config":
            if not equals:
                next(words, None)
            kept.append(f"--config={CONFIG_FILE}")
        elif word.endswith(".py") and not word.startswith("-"):
            kept.append(Path(word).name)
        else:
            kept.append(word)
    return shlex.join(["swarm", "sim", *kept])


def keep_command(record: Path, arguments: Iterable[str]) -> None:
    """Write the command into the folder of a recording. Raises `OSError`."""
    atomic_write(record / COMMAND_FILE, f"{command_of(arguments)}\n".encode())
