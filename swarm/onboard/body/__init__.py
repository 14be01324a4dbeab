"""A robot's body at its prompt: make it stand or lie (`swarm balance`), drive it by keyboard (`swarm drive`)."""
