"""The decisions and computations of the dwm service, without IO."""
