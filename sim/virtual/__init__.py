"""A swarm in one process under a virtual clock: the cores that run on the robots, joined by an event queue.

Nothing here waits and nothing is random but by the seed, so a run is the same bit for bit each time, and as fast as the
machine computes it (docs/reference/simulation.md).
"""
