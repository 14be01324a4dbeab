"""The connection of robots under virtual time: their mesh services, and the links between them."""
