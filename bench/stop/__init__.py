"""The time from a stop to motors off, by each way that a stop can take."""
