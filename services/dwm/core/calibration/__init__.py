"""A robot's calibration: samples, the fit of a model to them, and the file that holds it. No IO."""
