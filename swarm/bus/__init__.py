"""The local Zenoh bus of a robot: the only package that imports zenoh."""
