"""The balancer's second process: it speaks to the bus for the loop, and neither waits for the other."""
