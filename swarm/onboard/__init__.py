"""The programs on a robot, at its prompt or at the far end of ssh. They import nothing of the laptop."""
