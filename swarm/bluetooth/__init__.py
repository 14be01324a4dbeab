"""Host Controller Interface of a Bluetooth adapter: what its connections tell, roles, supervision time-outs."""
