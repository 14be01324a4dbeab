"""The devices on the robot's I2C bus: registers, formats and times of each one, and what they show. No IO."""
