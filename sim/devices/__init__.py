"""Stand-ins of a robot's devices at its own edges: the I2C bus, the UWB module at a serial port, the world behind."""
