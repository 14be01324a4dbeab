"""`swarm commission`: leads a person through a new robot's parts until it stands. `core` has the procedure."""
