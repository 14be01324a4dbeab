"""The estimate of the body's state from the sensors: the gyro's zero, tilt, heading, and whether it lies or stands.
No IO."""
