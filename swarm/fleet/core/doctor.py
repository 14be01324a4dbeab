"""All checks of `swarm doctor`, on one robot and across the swarm."""

from collections.abc import Callable, Sequence

from swarm.fleet.core import checks_robot, checks_system
from swarm.fleet.core.checkup import Check, Finding, Robot, warning

CHECKS: tuple[Check, ...] = (*checks_system.CHECKS, *checks_robot.CHECKS)


def examine(robot: Robot) -> dict[str, Finding]:
    """What each check says of a robot, by name."""
    return {check.name: _judge(check, robot) for check in CHECKS}


def _judge(check: Check, robot: Robot) -> Finding:
    try:
        return check.judge(robot)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        # Robots answer with the fields that their own release has.
        return warning(
            f"its answer cannot be read ({type(error).__name__}: {error})",
            "is its release another one than here? swarm deploy the same to all",
        )


def compare(robots: Sequence[Robot]) -> list[str]:
    """What must be the same on all robots of a swarm, and is not."""
    asked: dict[str, Callable[[Robot], str | None]] = {
        "releases (swarm deploy the same to all)": _release,
        "firmware (swarm flash the same to all)": _firmware,
        "keys (swarm deploy --key FILE to all)": _keys,
    }
    lines = []
    for what, value in asked.items():
        found = {robot.name: value(robot) for robot in robots}
        values = sorted({each for each in found.values() if each is not None})
        if len(values) > 1:
            rows = (f"{each}: {' '.join(name for name, its in found.items() if its == each)}" for each in values)
            lines.append(f"different {what}: {'; '.join(rows)}")
    return lines


def _release(robot: Robot) -> str | None:
    return None if robot.system is None else robot.system["current"] or None


def _firmware(robot: Robot) -> str | None:
    said = robot.said("balancer/firmware")
    return f"revision {said['revision']}" if "revision" in said else None


def _keys(robot: Robot) -> str | None:
    """During a rotation a file holds two; robots with one of them still speak to each other."""
    if robot.config.mesh.key_file is None or robot.key is None or len(robot.key["ids"]) != 1:
        return None
    return str(robot.key["ids"][0])
