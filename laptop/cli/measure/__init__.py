"""`swarm measure` on a laptop: what a robot measures, with a picture of it; and the slot radio fitted to recordings."""
