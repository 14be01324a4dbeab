"""Releases: making and bundling one, installing it on a robot, and which one robots run."""
