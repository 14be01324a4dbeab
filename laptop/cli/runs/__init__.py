"""Commands that make runs and look at them: simulations, sweeps, recordings, the live page."""
