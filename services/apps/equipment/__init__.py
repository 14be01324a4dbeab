"""The equipment of an app's robot: clients of its devices, measurements, recorded values, and a log on the bus."""
