"""`swarm foxglove`: the running swarm, for Foxglove over its WebSocket protocol."""
