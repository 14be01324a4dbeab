"""How the robot balances: the body's model, its estimate, the regulators and the manoeuvres. No IO."""
