"""The configuration of Zenoh on a robot: one router on a Unix socket, every service a client of it.

See docs/explanation/bus.md.
"""

import json

from swarm.messages.codec import MAX_BINARY

_MAX_MESSAGE = 2 * MAX_BINARY
"""Size in bytes of a message at which Zenoh closes a connection. Our messages are far smaller, so this only affects a
broken sender."""

_HANDSHAKE = {"open_timeout": 3_600_000, "accept_timeout": 3_600_000}
"""Time limits for making a connection, ms, at its two ends. None is needed, since the end of a process closes its Unix
sockets. Zenoh's default of 10 s could pass on an overloaded machine after the connection was registered and before the
task that reads from it was started. Then nobody ever read from it. Its keep-alives went on, and all further connections
were refused (MAX_LINKS), so the service stayed deaf (Zenoh 1.10, `init_new_transport_unicast`)."""

_BATCHES = 16
"""Batches of 64 KiB that a session's queue of normal messages holds, the most Zenoh allows. With its default of 2 a
message of more than 128 KiB was always lost, since one thread both fills and empties the queue. It costs 0.2 MB a
session (measured)."""


def router_config(endpoint: str) -> str:
    """Zenoh configuration (JSON) of a robot's router: one Unix socket, nothing on the network."""
    return json.dumps(
        {
            "mode": "router",
            "listen": {"endpoints": [endpoint], "exit_on_failure": True},
            "connect": {"endpoints": []},
            # Without the delay of 0 Zenoh waits 0.5 s at the start for neighbours that it may not look for anyway.
            # Services that talk to each other most learn of each other by the router's gossip (`peer_config`).
            "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": True, "multihop": True}},
            "timestamping": {"enabled": {"router": True, "peer": False, "client": False}},
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
            "transport": {
                "unicast": {"max_sessions": 64, **_HANDSHAKE},
                "link": {
                    "protocols": ["unixsock-stream"],
                    "tx": {
                        "lease": 10000,
                        "keep_alive": 4,
                        "queue": {
                            "size": {"data": _BATCHES},
                            "congestion_control": {
                                "drop": {"wait_before_drop": 1000},
                                "block": {"wait_before_close": 20000},
                            },
                        },
                    },
                    "rx": {"max_message_size": _MAX_MESSAGE},
                },
                "shared_memory": {"enabled": False},
            },
        }
    )


def client_config(endpoint: str) -> str:
    """Zenoh configuration (JSON) of a service: a client of one router, retrying for ever."""
    return json.dumps(
        {
            "mode": "client",
            "connect": {
                "endpoints": [endpoint],
                "timeout_ms": -1,
                "exit_on_failure": False,
                "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
            },
            "listen": {"endpoints": []},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "queries_default_timeout": 1000,
            "transport": {
                "unicast": _HANDSHAKE,
                "link": {
                    "protocols": ["unixsock-stream"],
                    "rx": {"max_message_size": _MAX_MESSAGE},
                    "tx": {
                        "queue": {
                            "size": {"data": _BATCHES},
                            "congestion_control": {"block": {"wait_before_close": 20000}},
                        }
                    },
                },
                "shared_memory": {"enabled": False},
            },
        }
    )


def peer_config(endpoint: str, listen: str, lasting: str = "") -> str:
    """Zenoh configuration (JSON) of a service that others of its kind reach directly, at the Unix socket `listen`. Of
    all others it is a client, like every service.

    Such services learn of each other by the router's gossip. The router does not pass messages between them, so two
    whose connection is broken are silent towards each other. Only with "multihop", in the router too, does the router
    tell the one that the other has lost it, and the connection is made again (measured). `lasting` is an endpoint that
    this one connects to by itself whenever there is no connection, which works while the router is away, too.
    """
    config = json.loads(client_config(endpoint))
    config["mode"] = "peer"
    config["listen"] = {"endpoints": [listen], "exit_on_failure": False}
    if lasting:
        config["connect"]["endpoints"].append(lasting)
    # Without it Zenoh waits 0.5 s at the start for neighbours that it may not look for anyway.
    config["scouting"]["delay"] = 0
    config["scouting"]["gossip"] = {
        "enabled": True,
        "multihop": True,
        "autoconnect": {"router": [], "peer": ["router", "peer"]},
    }
    return json.dumps(config)
