"""`python -m laptop.cli`: the `swarm` command."""

from laptop.cli import main

main()
