"""The text of a `swarm.toml` from a `Config`: a simulation writes it for the robots that it starts, and a recording
keeps it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from swarm.config.load import AUTO
from swarm.config.types import DEFAULT_RELAY, Config
from swarm.errors import LocalError


def dump(config: Config) -> str:
    """Return the text that `swarm.config.parse` reads as `config`."""
    import tomli_w  # only where one is written

    rules = config.relay[len(DEFAULT_RELAY) :]
    if config.relay != DEFAULT_RELAY + rules:
        raise LocalError("a config whose relay rules do not begin with the default ones cannot be written")
    document: dict[str, Any] = {"network": config.network, "robots": _plain(config.robots)}
    document["topology"] = AUTO if config.auto else {"edges": _plain(config.edges)}
    for name in ("mesh", "anchors", "dwm", "recordings", "simulation"):
        document[name] = _plain(getattr(config, name))
    for name, robots in (("body", config.bodies), ("balancing", config.balancings)):
        document[name] = {**_plain(getattr(config, name)), "robots": _plain(robots)}
    if config.packages:
        document["robot"] = {"packages": list(config.packages)}
    document["relay"] = _plain(rules)
    document["apps"] = {
        name: {**_plain(app.parameters), "robots": _plain(app.robots)} for name, app in config.apps.items()
    }
    text: str = tomli_w.dumps(document)
    return text


def _plain(value: Any) -> Any:
    """Tables and lists of what TOML knows; an entry that is None is left out, as TOML has no such value."""
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items() if entry is not None}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return value
