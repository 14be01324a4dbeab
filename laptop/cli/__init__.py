"""The command `swarm COMMAND ...`; `laptop.cli.commands` has the table of commands.

The module of a command is imported only when the command is used, since imports are slow.
"""

import argparse
import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from laptop.cli.commands import COMMANDS, Command, CommandGroup, help_of, names, usage, usage_of
from swarm import __version__
from swarm.errors import LocalError, SwarmError
from swarm.process.terminal import guard


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Entry point of `swarm`: our own errors are one line on stderr and exit code 2, never a traceback."""
    guard()
    try:
        code = _main(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except SwarmError as error:
        sys.stderr.write(f"swarm: {error}\n")
        code = 2
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:
        code = 141  # as a program that SIGPIPE ends: `swarm config --example | head` is no fault
        _forget_output()
    except OSError as error:
        sys.stderr.write(f"swarm: {error}\n")  # a full disk, mostly
        code = 2
        _forget_output()
    sys.exit(code)


def _main(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        sys.stdout.write(usage())
        return 0 if argv else 2
    name, *rest = argv
    if name == "--version":
        sys.stdout.write(f"swarm {__version__}\n")
        return 0
    command = COMMANDS.get(name)
    if command is None:
        raise LocalError(f"no command {name!r}; {_hint(name)}")
    if not isinstance(command, CommandGroup):
        return _call(name, command, rest)
    if rest and (chosen := command.commands.get(rest[0])) is not None:
        return _call(f"{name} {rest[0]}", chosen, rest[1:])
    if rest in (["-h"], ["--help"]) or not (rest or command.alone):
        sys.stdout.write(usage_of(name, command))
        return 0 if rest else 2
    if not command.alone or (rest and not rest[0].startswith("-")):
        there = ", ".join(f"{name} {sub}" for sub in command.commands)
        raise LocalError(f"no command '{name} {rest[0]}'; there are {there}")
    return _call(f"{name} {command.alone}", command.commands[command.alone], rest)


def _call(name: str, command: Command, rest: list[str]) -> int:
    """Run a command with the arguments that the user gave; returns the exit code."""
    module = importlib.import_module(command.module)
    if not hasattr(module, "add_arguments"):
        sys.argv = ["swarm", *command.first, *rest]
        return module.main() or 0
    parser = argparse.ArgumentParser(prog=f"swarm {name}", description=help_of(command))
    module.add_arguments(parser)
    code: int = module.run(parser.parse_args([*command.first, *rest]))
    return code


def _hint(name: str) -> str:
    """Return which command may be meant: one of the same last word, or one that is spelled like it."""
    known = names()
    same = [each for each in known if each.split()[-1] == name]
    near = same or difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(COMMANDS)}"


def _forget_output() -> None:
    """Point stdout to nowhere, or the interpreter would fail once more when it flushes at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
