"""A machine of the lab as a whole robot: the installed units, on a live I2C bus and a simulated DWM1001."""
