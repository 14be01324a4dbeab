"""A live /dev/i2c-1 with the simulated robot behind it, for the machines of the lab."""
