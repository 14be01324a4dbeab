"""A command line made of a table: it finds the command that is meant, shows help, and ends with the right exit code.

The robot's table is in `swarm.onboard.commands`, the laptop's in `laptop.cli.commands`. The module of a command is
imported only when the command is used, since imports are slow.
"""

import argparse
import ast
import contextlib
import difflib
import importlib
import os
import re
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

from swarm import __version__
from swarm.errors import LocalError, SwarmError
from swarm.process.arguments import CommandParser
from swarm.process.end import leave
from swarm.process.terminal import guard


class Command(NamedTuple):
    """One command: a module, or a program."""

    module: str
    """The module has `HELP`, `add_arguments(parser)` and `run(args) -> int`, or `main()`, which reads `sys.argv`."""
    first: tuple[str, ...] = ()
    """Arguments that come before those that the user gives."""
    help: str = ""
    """One line of help; empty where the module has it as `HELP`."""
    far: str = ""
    """Module that runs the command on robots elsewhere, by `run(name, words)`, which returns None where it is meant
    here."""
    alone: str = ""
    """The verb that is meant where none is named, as `show` of `swarm mesh topology`; empty: none is added."""


class CommandGroup(NamedTuple):
    """Commands under one word, as in `swarm hand press`."""

    help: str
    commands: dict[str, Command]
    alone: str = ""
    """The command that is meant where none is named; empty: one must be named."""


Commands = Mapping[str, Command | CommandGroup]
Sections = Mapping[str, Commands]
"""Commands by the title above them in the help."""

UNIX_MODULES = frozenset({"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"})
"""Modules of Python that Windows lacks."""

_ROOT = Path(__file__).parents[2]
"""The folder that contains the packages."""

_WIDTH = 100
"""Characters of a line of the help; of a group with more commands the first ones are listed."""

MORE = "more"
"""Title of the section whose commands share one line of the help, without a text for each."""

FAR_OPTIONS = "Real robots, over ssh: --real, --config FILE, --ssh-config FILE."
"""Last line of the help of a command that a laptop can have real robots run."""

_HELP = re.compile(r'^HELP = (".*")$', re.MULTILINE)


def main(sections: Sections, argv: Sequence[str] | None = None) -> NoReturn:
    """Run a command and end: our own errors are one line on stderr and exit code 2, never a traceback."""
    end_with("swarm", lambda: _main(sections, list(sys.argv[1:] if argv is None else argv)))


def end_with(program: str, run: Callable[[], int], *, interrupted: int = 130, unread: int = 141) -> NoReturn:
    """End this process with the exit code of `run`; an error of ours is one line on stderr and exit code 2.

    `interrupted`: exit code after Ctrl-C. `unread`: where nobody reads on, as in `swarm config --example | head`.
    """
    guard()
    try:
        code = run()
        sys.stdout.flush()
    except SwarmError as error:
        complain(program, str(error))
        code = 2
    except (ModuleNotFoundError, AttributeError) as error:
        if not _is_of_linux(error):
            raise
        complain(program, f"this command needs Linux (on Windows: WSL): Python has no {error.name} here")
        code = 2
    except (KeyboardInterrupt, RuntimeError) as error:
        if not _is_interrupt(error):
            raise
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second one must not disturb the end
        code = interrupted
        _leave_output()
    except BrokenPipeError:
        code = unread
        _leave_output()
    except OSError as error:
        # A full disk behind stdout, mostly, or a file that cannot be made.
        complain(program, f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error))
        code = 2
        _leave_output()
    leave(code)


def _is_of_linux(error: ModuleNotFoundError | AttributeError) -> bool:
    """Return whether something is missing that Python has on Linux, and not on every system."""
    if isinstance(error, ModuleNotFoundError):
        return error.name in UNIX_MODULES
    return getattr(error.obj, "__name__", "") in ("os", "signal", "socket", "time")


def _is_interrupt(error: BaseException | None) -> bool:
    """Return whether Ctrl-C was pressed.

    It may come while a `Condition`, an `Event` or a `Queue` of Python takes its lock back after a wait. Python then
    releases a lock that is not held, and its `RuntimeError` hides the interrupt.
    """
    while isinstance(error, RuntimeError):
        error = error.__context__
    return isinstance(error, KeyboardInterrupt)


def complain(program: str, text: str) -> None:
    """Write a line to stderr, if anybody reads it."""
    with contextlib.suppress(OSError):
        sys.stderr.write(f"{program}: {text}\n")
        sys.stderr.flush()


def commands_of(sections: Sections) -> dict[str, Command | CommandGroup]:
    """Return all commands and groups by the word that is typed behind `swarm`."""
    return {name: each for section in sections.values() for name, each in section.items()}


def names(commands: Commands) -> list[str]:
    """Return every command as it is typed behind `swarm`, groups with each of their commands."""
    found: list[str] = []
    for name, each in commands.items():
        found += [f"{name} {sub}" for sub in each.commands] if isinstance(each, CommandGroup) else [name]
    return found


def help_of(command: Command | CommandGroup) -> str:
    """Return the one line of help, read from the text of the module: importing all modules takes long."""
    if command.help:
        return command.help
    assert isinstance(command, Command)
    path = _ROOT.joinpath(*command.module.split(".")).with_suffix(".py")
    found = _HELP.search(path.read_text(encoding="utf-8"))
    assert found is not None, command.module
    text: str = ast.literal_eval(found[1])
    return text


def parser_of(name: str, command: Command) -> argparse.ArgumentParser:
    """Return the parser of a command whose module has `add_arguments`."""
    epilog = FAR_OPTIONS if command.far else None
    parser = CommandParser(prog=f"swarm {name}", description=sentence(help_of(command)), epilog=epilog)
    importlib.import_module(command.module).add_arguments(parser)
    return parser


def sentence(text: str) -> str:
    """Return a line of the help as a sentence: with a capital letter and a full stop."""
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "...")) else ".")


def add_verb(
    verbs: "argparse._SubParsersAction[argparse.ArgumentParser]", name: str, text: str, epilog: str | None = None
) -> argparse.ArgumentParser:
    """Add a verb of a command, and return its parser; `text` describes it in the command's help and in its own."""
    return verbs.add_parser(name, help=text, description=sentence(text), epilog=epilog)


def _main(sections: Sections, argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        sys.stdout.write(_usage(sections))
        return 0 if argv else 2
    name, *rest = argv
    if name == "--version":
        sys.stdout.write(f"swarm {__version__}\n")
        return 0
    commands = commands_of(sections)
    command = commands.get(name)
    if command is None:
        raise LocalError(f"no command {name!r}; {_hint(name, commands)}")
    if not isinstance(command, CommandGroup):
        return _call(name, command, rest)
    if rest and (chosen := command.commands.get(rest[0])) is not None:
        return _call(f"{name} {rest[0]}", chosen, rest[1:])
    if rest in (["-h"], ["--help"]) or not (rest or command.alone):
        sys.stdout.write(_usage_of(name, command))
        return 0 if rest else 2
    if not command.alone or (rest and not rest[0].startswith("-")):
        there = ", ".join(f"{name} {sub}" for sub in command.commands)
        raise LocalError(f"no command '{name} {rest[0]}'; there are {there}")
    return _call(f"{name} {command.alone}", command.commands[command.alone], rest)


def _call(name: str, command: Command, rest: list[str]) -> int:
    """Run a command with the arguments that the user gave; returns the exit code."""
    rest = with_verb(command, rest)
    if command.far and (there := importlib.import_module(command.far).run(name, rest)) is not None:
        return int(there)
    module = importlib.import_module(command.module)
    if not hasattr(module, "add_arguments"):
        sys.argv = ["swarm", *command.first, *rest]
        return module.main() or 0
    code: int = module.run(parser_of(name, command).parse_args([*command.first, *rest]))
    return code


def with_verb(command: Command, rest: list[str]) -> list[str]:
    """Return the words after a command with the verb that is meant where none is named."""
    if command.alone and (not rest or (rest[0].startswith("-") and rest[0] not in ("-h", "--help"))):
        return [command.alone, *rest]
    return rest


def _hint(name: str, commands: Commands) -> str:
    """Return which command may be meant: one of the same last word, or one that is spelled like it."""
    known = names(commands)
    same = [each for each in known if each.split()[-1] == name]
    near = same or difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(commands)}"


def _usage(sections: Sections) -> str:
    """Return what `swarm --help` prints: one line for each command, at most 100 characters wide, on one screen."""
    lines = ["usage: swarm COMMAND ...   (swarm COMMAND --help, swarm --version)"]
    for title, section in sections.items():
        if title == MORE:
            lines.append(f"{title}: {', '.join(section)}")
        else:
            lines += [f"{title}:", *(_line(name, each) for name, each in section.items())]
    return "\n".join([*lines, ""])


def _usage_of(name: str, group: CommandGroup) -> str:
    """Return what `swarm GROUP --help` prints."""
    lines = [f"usage: swarm {name} COMMAND ...   (swarm {name} COMMAND --help)", "", f"{group.help}:"]
    lines += [_line(sub, each) for sub, each in group.commands.items()]
    if group.alone:
        lines += ["", f"`swarm {name}` alone is `swarm {name} {group.alone}`."]
    return "\n".join([*lines, ""])


def _line(name: str, command: Command | CommandGroup) -> str:
    text = help_of(command)
    if isinstance(command, CommandGroup):
        text = f"{text}: {', '.join(command.commands)}"
    line = f"  {name:<10} {text}"
    return line if len(line) <= _WIDTH else line[: line.rindex(",", 0, _WIDTH - 4)] + ", ..."


def _leave_output() -> None:
    """Write what can be written, then point stdout to nowhere: the interpreter flushes it again at its end."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
