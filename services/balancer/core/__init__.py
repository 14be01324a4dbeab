"""Registers, model, regulator, estimator and modes of the balancer: all pure, with time as an argument."""
