"""What an app's robot has: clients of its devices, measurements, recorded values, and a voice on the bus."""
