"""Runs for programs and notebooks: `swarm.simulate`, `swarm.sweep` and `swarm.load`.

See docs/how-to/simulation/from-python.md.
"""
