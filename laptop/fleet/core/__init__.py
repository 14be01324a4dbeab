"""The decisions of the commands for robots, without IO: no ssh, no files, no clock."""
