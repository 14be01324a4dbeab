"""The replacements of one robot's hardware under virtual time: balancer, body, UWB module, and the contacts of
bodies."""
