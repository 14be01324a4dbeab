"""New firmware for a Balboa, over its USB cable."""
