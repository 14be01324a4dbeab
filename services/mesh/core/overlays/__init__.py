"""What crosses more than one link: flood, unicast, stop. Imports `wire`, `routing` and `bulk`."""
