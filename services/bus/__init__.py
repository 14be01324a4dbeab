"""The Zenoh router of one robot: where its services meet."""
