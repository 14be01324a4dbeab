"""The robots of the swarm, the links that there are and that are wanted, and the routes over them.

`topology` has the graphs and the shortest paths, `link_state` what all robots tell of their links, `wanted_links` which
links this robot asks for, `physical_links` which of them the radio has and who calls, `spare_links` which it can drop,
`automatic_topology` the rule that plans them where nobody does, `membership` who is there.
Users: `overlays`; simulations and the shell make a `Ground` and `InitialLinks`.
"""
