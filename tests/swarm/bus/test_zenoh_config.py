"""Zenoh's configuration: what its library makes of ours."""

import json

import pytest

from swarm.bus.zenoh_config import client_config, peer_config, router_config
from swarm.bus.zenoh_runtime import zenoh

END = "unixsock-stream//tmp/bus.sock"


@pytest.mark.parametrize("config", [router_config(END), client_config(END), peer_config(END, END)])
def test_zenoh_gives_a_connection_all_the_time_that_a_starved_machine_needs(config: str) -> None:
    unicast = json.loads(zenoh.Config.from_json5(config).get_json("transport/unicast"))
    assert unicast["open_timeout"] == unicast["accept_timeout"] == 3_600_000
