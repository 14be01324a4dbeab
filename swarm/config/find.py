"""The search for the swarm's file: in the working directory, the user's configuration folder or /etc."""

import os
from pathlib import Path

NAME = "swarm.toml"
SYSTEM = Path("/etc/swarm")

LOOKED_IN = "SWARM_CONFIG, else swarm.toml in the working directory, in ~/.config/swarm, in /etc/swarm"
"""The search order in words, for help texts."""


def user_folder() -> Path | None:
    """Return the folder of this user's settings: `swarm` in XDG_CONFIG_HOME, else in ~/.config; None without a home."""
    # The XDG base directory specification: a path that is not absolute is ignored. A service has no HOME.
    homes = (Path(os.environ.get("XDG_CONFIG_HOME", "")), Path(os.environ.get("HOME", "")) / ".config")
    return next((home / "swarm" for home in homes if home.is_absolute()), None)


def places() -> tuple[Path, ...]:
    """Return the paths where the file is looked for, the first one first.

    The variable SWARM_CONFIG names the only one. Without it they are the working directory, `swarm` in the user's
    configuration folder (XDG_CONFIG_HOME, else ~/.config) and /etc/swarm, where robots have it.
    """
    if named := os.environ.get("SWARM_CONFIG"):
        return (Path(named),)
    folders = (_working_folder(), user_folder(), SYSTEM)
    return tuple(folder / NAME for folder in folders if folder is not None)


def _working_folder() -> Path | None:
    """Return the working directory; None where it was deleted: a stop finds its robots in the other places."""
    try:
        return Path.cwd()
    except FileNotFoundError:
        return None


def find() -> Path | None:
    """Return the path of the swarm's file, None where it is in none of its places.

    A file that is there and cannot be read counts, and so does one that SWARM_CONFIG names and that is missing: what is
    wrong with it is better told than passed over.
    """
    found = places()
    return next((path for path in found if os.path.lexists(path)), found[0] if is_named() else None)


def is_named() -> bool:
    """Return whether the variable SWARM_CONFIG names the file."""
    return bool(os.environ.get("SWARM_CONFIG"))
