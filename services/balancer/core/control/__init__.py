"""The control of the robot's balance: the body's model, its estimate, the regulators and the manoeuvres. No IO."""
