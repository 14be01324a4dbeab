"""What is asked of a simulation: options, checked before anything starts, and the config that comes of them."""
