"""`swarm mesh`: the robots, their links, the topology and the members of runs."""
