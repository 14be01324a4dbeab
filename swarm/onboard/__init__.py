"""What runs on a robot at its prompt or at the far end of ssh. It imports nothing of the laptop."""
