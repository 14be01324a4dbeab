"""`python -m bench.stop.estop ARGUMENTS`: `swarm ARGUMENTS` of a release whose `Stop` has a field more.

It stands in for `swarm estop` where a robot must obey a release that it does not know.
"""

from laptop.cli import main
from swarm.frozen import frozen
from swarm.onboard import halt


@frozen
class NewerStop:
    """A `Stop` of some later release."""

    t: float
    origin: str
    reason: str
    severity: int = 3


if __name__ == "__main__":
    setattr(halt, "Stop", NewerStop)  # noqa: B010 - the module does not offer its own names
    main()
