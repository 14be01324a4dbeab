"""What stands in the place of one robot under virtual time: balancer, body, UWB module, and the contacts of bodies."""
