"""`swarm sweep`: one app under virtual time, over robots, topologies, parameters and seeds, on all cores."""
