"""Transports of the mesh: ordered byte pipes that may die."""
