"""The scenario of a simulation: options, checked before anything starts, and the config made from them."""
