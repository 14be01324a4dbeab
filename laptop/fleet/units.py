"""systemd units by the names that people use: mesh, app consensus, or nothing for all of them."""

from collections.abc import Sequence

from swarm.errors import LocalError
from swarm.messages.keys import is_name

SERVICES = ("bus", "mesh", "balancer", "dwm")
TARGET = "swarm.target"
JOURNAL_OF_ALL = f"--unit=swarm-{SERVICES[0]}.service --unit='swarm*'"
"""Options of journalctl for all services and apps. It fails where it is given a pattern alone and no unit matches."""


def unit(name: str) -> str:
    """Return the unit of a service, or of the app of that name. Raises `LocalError` where there can be neither."""
    if name in SERVICES:
        return f"swarm-{name}.service"
    if is_name(name):
        return f"swarm-app@{name}.service"
    raise LocalError(f"{name!r}: expected {', '.join(SERVICES)} or the name of an app")


def is_app(unit: str) -> bool:
    """Return whether this is the unit of an app."""
    return unit.startswith("swarm-app@")


def units(names: Sequence[str]) -> list[str]:
    """Return the units of these services and apps; the target that holds all services where none is named."""
    return [unit(name) for name in names] or [TARGET]


def kill_command(name: str) -> str:
    """Return the robot's command that ends the main process of a service or an app as a crash would. systemd starts it
    again. The command fails where the process does not run. Raises `LocalError` as `unit` does."""
    what = unit(name)
    # Not `is-active`: an app that waits for its first measurement is "activating", and runs.
    runs = f'[ "$(systemctl show --property=MainPID --value {what})" != 0 ]'
    none = '{ echo "it is not running at this moment" >&2; exit 1; }'
    return f"sudo -n sh -c '{runs} || {none}; systemctl kill --kill-whom=main --signal=KILL {what}'"
