"""Without IO: packets of the host controller interface, controllers, pairing, the air."""
