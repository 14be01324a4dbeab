"""The manoeuvres that take the place of balancing: the body stands up, lies down, or tries its motors. No IO."""
