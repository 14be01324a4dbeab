"""`z_sub` on a laptop: the program of a robot, which also watches real robots over ssh (`--robots NAME`)."""

import argparse
from typing import NoReturn

from swarm.onboard import z_sub
from swarm.process.terminal import guard


def main() -> NoReturn:
    """Entry point of the command `z_sub`."""
    guard()
    z_sub.main(over_ssh=_over_ssh)


def _over_ssh(options: argparse.Namespace) -> int:
    from laptop.cli import z_sub_ssh  # asyncio is slow to import, and most uses of z_sub do without

    return z_sub_ssh.watch(options)


if __name__ == "__main__":
    main()
