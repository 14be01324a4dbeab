"""Commands for real robots over ssh, and for their configuration and key."""
