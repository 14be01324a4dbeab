"""`swarm estop` and `swarm arm`: stop every robot, and take the stop back."""
