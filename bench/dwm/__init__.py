"""The UWB service and its filters: what an update costs, and the pose of a moving robot."""
