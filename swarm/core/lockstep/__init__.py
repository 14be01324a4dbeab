"""One robot's lockstep with its neighbours: the protocol, its frames, what it asks for, and the stop by rule."""
