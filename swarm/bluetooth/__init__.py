"""Host Controller Interface of a Bluetooth adapter: signal strength and supervision time-outs."""
