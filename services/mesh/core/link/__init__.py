"""One link to one neighbour: session, handshake, heartbeat, dialling, queues, clock. Imports `wire`."""
