"""What the commands for robots decide, without doing it: no ssh, no files, no clock."""
