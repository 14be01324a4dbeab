"""The estimation of a pose from ranges and odometry: filters, multilateration and the Kalman filter. No IO."""
