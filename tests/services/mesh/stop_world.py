"""Stops and re-arms in swarms that are joined in memory."""

from overlay_world import World

from swarm.messages import Stop, Stopped

NOTICED = 1.0
"""s in which news of a closed socket, or of a new link, have reached everybody."""


def stop(world: World, name: str, reason: str = "smoke") -> None:
    world.step(name, lambda each: each.stop(Stop(world.now, name, reason), world.now))


def arm(world: World, name: str) -> None:
    world.step(name, lambda each: each.arm(world.now))


def stopped(world: World, name: str) -> Stopped:
    return world.bots[name].overlays.stopped(world.now)
