"""What the dwm service does, without IO."""
