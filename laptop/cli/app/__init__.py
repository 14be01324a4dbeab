"""`swarm app`: start, stop and set apps while they run."""
