"""The overlays, which cross more than one link: flood, unicast, large messages, stops, and the requests of apps.

`robot_overlays` joins all of one robot, and is what `node` and `connections` use. `flood` spreads (`echo` confirms,
`flood_store` remembers), `unicast` goes hop by hop, `large_messages` has both of more than a packet, `stop` the
register of stops, `requests` the tickets of apps. `viewing` is apart: the shell uses it to show the swarm on one
robot's bus.
"""
