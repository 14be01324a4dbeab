"""Actions on a running simulation: the datagrams that commands send to it."""
