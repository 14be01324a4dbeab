"""What the mesh does, without IO."""
