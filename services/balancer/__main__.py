"""`python -m services.balancer`: the balancer of a real robot."""

from services.balancer.loop import main
from swarm.process.edges import run

if __name__ == "__main__":
    run(main, "Run the balancer of this robot, which owns the I2C bus, keeps the robot upright and drives it.")
