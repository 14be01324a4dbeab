"""The lockstep of one robot with its neighbours: the protocol, its frames, its actions, and the stop by rule."""
