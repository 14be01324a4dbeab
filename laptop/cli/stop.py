"""`swarm stop [SERVICE...]`: systemd's, on all robots."""

import argparse

from laptop.fleet import control

HELP = "stop services or apps of all robots, over ssh (motors at once: estop)"

add_arguments = control.add_arguments


def run(args: argparse.Namespace) -> int:
    """0 where it succeeded on every robot."""
    return control.run(args, "stop")
