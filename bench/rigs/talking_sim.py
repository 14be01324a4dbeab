"""`swarm sim` whose robots only talk: bus, mesh and app as ever, but no balancer (with its simulated body) and no UWB.

A robot has four cores, one of them for its 100 Hz loop alone. Six robots' bodies and loops would take half of a
computer's two, and with that hold up what on a robot they do not.

`python -m bench.rigs.talking_sim ARGUMENTS`, as of `swarm sim`, with an app that neither moves nor measures.
"""

from laptop.cli.runs import sim
from sim.processes import run
from swarm.process import service

PROGRAM = ("bench.rigs.talking_sim",)
"""For `bench.rigs.simulation`."""

LEFT_OUT = ("balancer", "dwm")


def main() -> int:
    """Like `swarm sim`, which waits for no other services than it starts."""
    for name in LEFT_OUT:
        del run.SERVICE_MODULES[name]
    return sim.main()


if __name__ == "__main__":
    service.run(main)
