"""What the sensors tell of the body: the gyro's zero, tilt, heading, and whether it lies or stands. No IO."""
