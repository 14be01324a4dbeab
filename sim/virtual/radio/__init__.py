"""What lies between robots under virtual time: their mesh services, and the links these speak over."""
