"""From ranges and odometry to a pose: filters, multilateration and the Kalman filter. No IO."""
