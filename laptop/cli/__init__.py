"""The command `swarm` of a laptop; `laptop.cli.commands` has the table of commands."""

from collections.abc import Sequence
from typing import NoReturn

from laptop.cli.commands import SECTIONS
from swarm.onboard import command_line


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Entry point of `swarm`: our own errors are one line on stderr and exit code 2, never a traceback."""
    command_line.main(SECTIONS, argv)
