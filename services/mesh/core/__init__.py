"""The decisions of a robot's mesh, without IO: the clock, randomness and bytes come in as arguments.

`node` is what the shell (`services.mesh`) and virtual time (`sim.virtual`) drive: they feed it bytes, samples of the
bus and the time, and carry out its `actions`. It joins the `relay` rules, the `connections` and the `overlays`.

    node          one robot: rules, connections and overlays joined; carries out what the overlays ask for
    connections   its sessions, and the links that they make
    calling       its own calls and knocks, and the calls of others until their handshake is over
    overlays/     flood, unicast, stop, what apps ask for
    bulk/         messages that are larger than a packet, and numbered messages
    routing/      who is there, which links there are and are to be, the ways over them
    link/         one connection: calls, handshake, heartbeats, queues, flow, clock
    wire/         bytes of frames and packets, authentication
    actions       what a core asks of its shell
    relay         which keys leave to whom, and which may come in

Imports run downwards in this order; `pyproject.toml` holds it.
"""
