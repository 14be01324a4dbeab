"""Simulated robots of real processes under a schedule of faults, and what must still be true afterwards."""
