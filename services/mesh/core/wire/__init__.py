"""Bytes between neighbours: frames, packets of the overlays, authentication. Imports no other folder of the core."""
