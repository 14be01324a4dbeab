"""What measurements run: simulations with fewer parts, stand-ins for robots, load, and apps that never settle."""
