"""`swarm measure`: round trips, throughput and signal of links; rates of the I2C bus."""
