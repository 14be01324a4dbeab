"""What the built-in apps compute: no IO, no clock, no randomness of their own."""
