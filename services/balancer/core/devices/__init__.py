"""What is on the robot's I2C bus: registers, formats and times of each device, and what they show. No IO."""
