"""The host of one app on a robot: its locksteps or events between bus and mesh, its topology, state and parameters."""
