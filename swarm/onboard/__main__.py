"""`python -m swarm.onboard`: the `swarm` command of a robot."""

from swarm.onboard.commands import run

run()
