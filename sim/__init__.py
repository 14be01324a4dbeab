"""The simulated world, and `swarm sim`: the only place that composes other services."""
