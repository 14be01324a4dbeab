"""The table of all checks of `swarm doctor`, on one robot and across the swarm."""

from collections.abc import Callable, Sequence

from laptop.fleet.core import checks_robot, checks_system
from laptop.fleet.core.answers import MISUNDERSTOOD, misunderstood
from laptop.fleet.core.checkup import SIMULATED, Check, ExaminedRobot, Finding, SimulatedError, bad

CHECKS: tuple[Check, ...] = (*checks_system.CHECKS, *checks_robot.CHECKS)


def examine(robot: ExaminedRobot) -> dict[str, Finding]:
    """Return the finding of each check, by name."""
    return {check.name: _judged(check, robot) for check in CHECKS}


def _judged(check: Check, robot: ExaminedRobot) -> Finding:
    try:
        return check.judge(robot)
    except SimulatedError:
        return SIMULATED
    except MISUNDERSTOOD as error:
        return bad(misunderstood(error), "the same release on all robots? swarm deploy")


def compare(robots: Sequence[ExaminedRobot]) -> list[str]:
    """Return what differs between robots of a swarm and must not."""
    asked: dict[str, Callable[[ExaminedRobot], str | None]] = {
        "releases (swarm deploy the same to all)": _release,
        "firmware (swarm flash the same to all)": _firmware,
    }
    lines = []
    for what, value in asked.items():
        found = {robot.name: _compared(value, robot) for robot in robots}
        values = sorted({each for each in found.values() if each is not None})
        if len(values) > 1:
            rows = (f"{each}: {' '.join(name for name, its in found.items() if its == each)}" for each in values)
            lines.append(f"different {what}: {'; '.join(rows)}")
    return [*lines, *_keys(robots)]


def _compared(value: Callable[[ExaminedRobot], str | None], robot: ExaminedRobot) -> str | None:
    try:
        return value(robot)
    except MISUNDERSTOOD:
        return None  # a check of the robot alone tells of that


def _release(robot: ExaminedRobot) -> str | None:
    return None if robot.system is None else robot.system["current"] or None


def _firmware(robot: ExaminedRobot) -> str | None:
    said = robot.said("balancer/firmware")
    return f"revision {said['revision']}" if "revision" in said else None


def _keys(robots: Sequence[ExaminedRobot]) -> list[str]:
    """Return a line about robots that have no key in common, and so no link; none where all have. While a key is
    replaced a file holds two of them."""
    ids = {
        robot.name: frozenset(map(str, robot.key["ids"]))
        for robot in robots
        if robot.config.mesh.key_file is not None and robot.key is not None and robot.key["ids"]
    }
    if all(one & other for one in ids.values() for other in ids.values()):
        return []
    kinds = sorted(set(ids.values()), key=sorted)
    rows = (f"{' '.join(sorted(kind))}: {' '.join(name for name, its in ids.items() if its == kind)}" for kind in kinds)
    return [f"different keys (swarm deploy --key FILE to all): {'; '.join(rows)}"]
