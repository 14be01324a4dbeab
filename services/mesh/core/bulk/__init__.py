"""Messages larger than a packet, fetched piece by piece. Imports `wire`."""
