"""What a person at a laptop waits for: a deployment to robots, and the live page."""
