"""The part of a swarm that does not move: names, links of the topology, anchors, the target."""

from typing import Any

from laptop.view.actions.control import Control
from laptop.view.feeds.feed import LiveFeed
from laptop.view.recording import ViewedRecording
from swarm.config.types import Config


def fixed_parts(feed: LiveFeed | ViewedRecording, control: Control | None) -> dict[str, Any] | None:
    """Return the part of the page that does not move: names, links of the topology, anchors."""
    config = feed.config
    if config is None:
        return None
    return {
        "kind": feed.kind,
        "acts": [] if control is None else list(control.acts),
        "robots": list(config.names),
        "edges": [list(edge) for edge in config.edges],
        "anchors": [{"name": anchor.address, "x": anchor.x, "y": anchor.y} for anchor in config.anchors],
        "target": _target(config),
    }


def _target(config: Config) -> dict[str, Any] | None:
    """Return the target's true place; of real robots it is unknown, unless the target is one of the anchors."""
    simulated = all(str(robot.link).startswith(("sim:", "slots:")) for robot in config.robots)
    if config.dwm.target is None or not simulated:
        return None
    x, y = config.simulation.target
    return {"name": "target's start" if config.simulation.moving else "target", "x": x, "y": y}
