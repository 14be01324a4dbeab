"""`python -m sim.body`: the balancer of one simulated robot, the real one but for its I2C bus.

The body moves with the loop's own clock (sim/core), tells its true pose to the world, and is acted upon by
people (sim/devices/world_client.py).
"""

from services.balancer.loop import main as balance
from sim.devices.wiring import lying, simulated_bus
from swarm.process.edges import run


def main() -> None:
    """Run the balancer. The robot stands up at once, since it endangers nobody. If it begins lying, it waits for a
    command."""
    balance(simulated_bus, start_mode="rest" if lying() else "stand")


if __name__ == "__main__":
    run(main)
