"""`swarm view`: the whole swarm on one page, live."""
