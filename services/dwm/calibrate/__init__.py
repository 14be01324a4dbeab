"""`swarm calibrate`: makes, checks and shows the calibration of a robot's UWB module."""
