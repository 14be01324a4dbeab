"""`swarm hand`: actions of a person on the robots of a running simulation."""
