"""Robots that stand: work that ends their balancer, and would let them fall, is refused."""

import argparse

from laptop.fleet.ssh.ssh import CURRENT, OWN_NAME, Host, HostError, Ssh
from services.balancer.core.control.controller import ON_ITS_FEET
from swarm.errors import PayloadError
from swarm.messages.json_input import read_json

ASK_S = 2.5
"""Seconds in which a running balancer publishes its state, which it does 25 times a second."""


def add_force(parser: argparse.ArgumentParser) -> None:
    """Declare `--force`, with which the work goes on."""
    parser.add_argument("--force", action="store_true", help="go on even where a robot stands: it may fall")


async def refuse_standing(ssh: Ssh, host: Host) -> None:
    """Raise `HostError` where the robot's balancer says that the robot stands. A robot that does not say its mode, such
    as one without a release or with stopped services, is not refused."""
    name = f'robot=$({OWN_NAME}); sudo -n {CURRENT}/bin/z_sub "swarm/${{robot:-{host.robot}}}/balancer/state"'
    done = await ssh.run(host, f"{name} --count 1 --seconds {ASK_S} --json")
    try:
        mode = str(read_json(done.out)["value"]["mode"])
    except (PayloadError, LookupError, TypeError, ValueError):
        return
    if mode in ON_ITS_FEET:
        raise HostError(
            f"it is {mode.replace('_', ' ')}, and would fall when its balancer ends: lay it down first "
            f"(swarm balance lie --robots {host.robot}), or --force"
        )
