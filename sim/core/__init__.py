"""Physics and sensors of the simulated world, without IO."""
