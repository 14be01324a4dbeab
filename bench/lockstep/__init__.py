"""The time of a lockstep iteration over emulated links, over links that are cut, and over a real kernel's RFCOMM."""
