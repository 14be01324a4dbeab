"""Overlays and links between real meshes: flood, unicast, large messages, authentication, and a common start."""
