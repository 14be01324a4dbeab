"""What the body does in place of balancing: it stands up, lies down, or tries its motors. No IO."""
