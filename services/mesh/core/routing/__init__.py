"""Who is in the swarm and how to reach them: membership, link state, topology. Imports `wire`."""
