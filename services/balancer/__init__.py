"""The balancer: 100 Hz loop, drivers of the I2C devices, safety, and the bridge to the bus.

See docs/reference/robot/balancer.md.
"""
