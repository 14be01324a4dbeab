"""A virtual robot lab: virtual machines with real kernel Bluetooth, real I2C devices and real systemd.

See docs/how-to/tools/use-the-lab.md.
"""
