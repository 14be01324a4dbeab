"""systemd units by the names that people use: mesh, app consensus, or nothing for all of them."""

from collections.abc import Sequence

from swarm.errors import LocalError
from swarm.keys import is_name

SERVICES = ("bus", "mesh", "balancer", "dwm")
TARGET = "swarm.target"


def unit(name: str) -> str:
    """The unit of a service, or of the app of that name; raises `LocalError` where it can be neither."""
    if name in SERVICES:
        return f"swarm-{name}.service"
    if is_name(name):
        return f"swarm-app@{name}.service"
    raise LocalError(f"{name!r}: expected {', '.join(SERVICES)} or the name of an app")


def units(names: Sequence[str]) -> list[str]:
    """The units of these, or the target that holds all services."""
    return [unit(name) for name in names] or [TARGET]
