"""Commands for the bodies of robots: they stand, drive, are commissioned, and get new firmware."""
