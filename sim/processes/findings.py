"""What follows from all that the robots of a run have told: who has started, failed or waits, and why."""

from collections.abc import Mapping, Sequence

from sim.processes.monitor import Seen
from sim.report import fault


def members(seen: Mapping[str, Seen]) -> tuple[str, ...]:
    """Return the members of the newest epoch that a robot knows."""
    epochs = [robot.epoch for robot in seen.values() if robot.epoch is not None]
    newest = max(epochs, key=lambda epoch: (epoch.epoch, epoch.frames), default=None)
    return tuple(seen) if newest is None else newest.members


def faults(seen: Mapping[str, Seen]) -> list[str]:
    """Return a sentence for each robot whose app has failed."""
    return [
        fault(name, "app", robot.progress.reason) for name, robot in seen.items() if robot.progress and failed(robot)
    ]


def held_up(seen: Mapping[str, Seen]) -> list[str]:
    """Return what members of the run wait for, except for a robot that is away."""
    waiting = [(name, seen[name].progress) for name in members(seen)]
    return [
        f"{name} app waits for {', '.join(told.waiting_for)} at iteration {told.k}: {told.reason}"
        for name, told in waiting
        if told is not None and told.phase == "waiting" and told.waiting_for and told.reason
    ]


def failed(seen: Seen) -> bool:
    """Return whether a robot's app has failed."""
    return seen.progress is not None and seen.progress.phase == "fault"


def iteration(seen: Seen) -> int:
    """Return the newest iteration that a robot has told of."""
    return max(seen.progress.k if seen.progress is not None else 0, seen.state.k if seen.state is not None else 0)


def messages(seen: Mapping[str, Seen]) -> int | None:
    """Return the number of app frames that all meshes have sent, as they count them in their status. Of a mesh that was
    killed, what it has sent since it told last is missing."""
    counts = [
        robot.sent_before + robot.status["mesh"].counters.get("sent_sync", 0)
        for robot in seen.values()
        if "mesh" in robot.status
    ]
    return sum(counts) if counts else None


def ready(seen: Mapping[str, Seen], missing: Mapping[str, Sequence[str]]) -> int:
    """Return how much of a starting swarm is there: services that are ready, links that are up, apps that report."""
    services = sum(len(robot.status.keys() - set(missing[name])) for name, robot in seen.items())
    links = sum(link.state == "up" for robot in seen.values() if robot.links for link in robot.links.links)
    return services + links + sum(robot.progress is not None for robot in seen.values())


def obstacles(seen: Mapping[str, Seen], missing: Mapping[str, Sequence[str]]) -> str:
    """Return why a swarm did not start, robot by robot."""
    found = []
    for name, robot in seen.items():
        if missing[name]:
            found.append(f"{name}: {', '.join(missing[name])} not ready")
        elif robot.progress is not None and robot.progress.k < 1:
            waits = (
                f"waits for {', '.join(robot.progress.waiting_for)}"
                if robot.progress.waiting_for
                else robot.progress.phase
            )
            found.append(f"{name}: app {waits} {robot.progress.reason}".rstrip())
    return "; ".join(found) or "the apps say nothing"
