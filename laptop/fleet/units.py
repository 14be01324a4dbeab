"""systemd units by the names that people use: mesh, app consensus, or nothing for all of them."""

from collections.abc import Sequence

from swarm.errors import LocalError
from swarm.messages.keys import is_name

SERVICES = ("bus", "mesh", "balancer", "dwm")
TARGET = "swarm.target"


def unit(name: str) -> str:
    """The unit of a service, or of the app of that name; raises `LocalError` where it can be neither."""
    if name in SERVICES:
        return f"swarm-{name}.service"
    if is_name(name):
        return f"swarm-app@{name}.service"
    raise LocalError(f"{name!r}: expected {', '.join(SERVICES)} or the name of an app")


def is_app(unit: str) -> bool:
    """Return whether this is the unit of an app."""
    return unit.startswith("swarm-app@")


def units(names: Sequence[str]) -> list[str]:
    """The units of these, or the target that holds all services."""
    return [unit(name) for name in names] or [TARGET]


def kill_command(name: str) -> str:
    """The robot's command that has the main process of a service or an app end as by a crash: what else it has started
    is left to systemd, which then starts it again. Fails where it does not run; raises `LocalError` as `unit`."""
    what = unit(name)
    # Not `is-active`: an app that waits for its first measurement is "activating", and runs.
    runs = f'[ "$(systemctl show --property=MainPID --value {what})" != 0 ]'
    none = '{ echo "it is not running at this moment" >&2; exit 1; }'
    return f"sudo -n sh -c '{runs} || {none}; systemctl kill --kill-whom=main --signal=KILL {what}'"
