"""The 100 Hz loop: its lateness beside `cyclictest`, its time on the I2C bus, and a robot's power."""
