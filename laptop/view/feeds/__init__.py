"""Where the page's pictures of a swarm come from: a simulation here, real robots, virtual time."""
