"""Average consensus in ten lines: `swarm sim examples/consensus.py --set r0.value=1 --set r1.value=4`."""

from math import fsum

from swarm import SyncApp


class Consensus(SyncApp):
    """Every robot ends on the mean of the starting values."""

    value: float

    def step(self, neighbours):
        """Move towards the neighbours' values."""
        self.value += fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))
