"""When a robot of a virtual run begins its iterations."""

from sim.virtual.run import VirtualRun


def moments_of(run: VirtualRun, robot: str) -> list[float]:
    """Return a list to which the run adds the time of each of the robot's iterations, s."""
    moments: list[float] = []
    advanced = run.advanced

    def note(source, line):
        if source.robot == robot:
            moments.append(run.world.time.now)
        advanced(source, line)

    run.advanced = note
    return moments
