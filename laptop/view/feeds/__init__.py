"""The sources of the page's picture of a swarm: a simulation here, real robots, virtual time."""
