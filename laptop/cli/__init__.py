"""The command `swarm VERB ...`.

A verb is a module of this package with `HELP` (one line), `add_arguments(parser)` and `run(args) -> int`; it
is imported only when it is used, since imports are slow on a Pi. Verbs that belong to a service are handed to
its process with their arguments untouched: the library knows services by name only.
"""

import argparse
import ast
import difflib
import importlib
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from swarm import __version__
from swarm.errors import LocalError, SwarmError
from swarm.process.terminal import guard

VERBS = (
    "app", "arm", "bundle", "command", "config", "deploy", "doctor", "epoch", "estop", "export", "fetch", "film",
    "import", "key", "kill", "lay", "logs", "measure", "mesh", "pair", "param", "plot", "press", "provision", "push",
    "reboot", "replay", "restart", "run", "start", "status", "stop", "topology", "unplug", "view",
)  # fmt: skip
"""Modules of this package."""

MODULES = {"import": "import_csv"}
"""Modules of verbs whose names Python has for itself."""

HANDED_ON = {
    "new": ("write a commented app and its test", ("sim.rehearsal.new",)),
    "check": (
        "look at an app before any robot moves: size, time, determinism, convergence",
        ("sim.rehearsal.check",),
    ),
    "calibrate": ("make and check the calibration of a robot's UWB module", ("services.dwm.calibrate",)),
    "flash": ("new firmware for the Balboas, over their USB cables and ssh", ("laptop.fleet.flash",)),
    "sim": ("simulate a swarm of real service processes (swarm sim --help)", ("laptop.cli.runs.sim",)),
    "sweep": ("an app under virtual time over parameters, topologies and seeds", ("laptop.cli.runs.sweep",)),
    "discover": ("Bluetooth devices in range, and which of them are robots", ("services.mesh.discover",)),
    "dwm": ("UWB modules: look, set up, find what is wrong (swarm dwm --help)", ("services.dwm.tool",)),
    "demo": ("three simulated robots find a target, in under a minute", ("laptop.cli.runs.sim", "--demo")),
}
"""Verb: its help, and the module and first arguments that it becomes."""

_HELP = re.compile(r'^HELP = (".*")$', re.MULTILINE)

KINDS = {("measure", "i2c"): "i2c"}
"""A verb's first argument that makes it another module of this package."""


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
        sys.stdout.write(_usage())
        return 0 if argv else 2
    verb, rest = argv[0], argv[1:]
    if verb == "--version":
        sys.stdout.write(f"swarm {__version__}\n")
        return 0
    if verb in HANDED_ON:
        program, *first = HANDED_ON[verb][1]
        sys.stdout.flush()
        os.execv(sys.executable, [sys.executable, "-m", program, *first, *rest])  # noqa: S606 - our own service
    if verb not in VERBS:
        near = difflib.get_close_matches(verb, [*VERBS, *HANDED_ON], n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join([*VERBS, *HANDED_ON])}"
        raise LocalError(f"no command {verb!r}; {hint}")
    module = KINDS.get((verb, rest[0] if rest else ""), verb)
    if module != verb:
        verb, rest = f"{verb} {rest[0]}", rest[1:]
    command = importlib.import_module(f"laptop.cli.{MODULES.get(module, module)}")
    parser = argparse.ArgumentParser(prog=f"swarm {verb}", description=command.HELP)
    command.add_arguments(parser)
    code: int = command.run(parser.parse_args(rest))
    return code


def _usage() -> str:
    helps = {verb: help_of(verb) for verb in VERBS}
    helps |= {verb: text for verb, (text, _) in HANDED_ON.items()}
    lines = [f"  {verb:<9} {text}" for verb, text in helps.items()]
    return "\n".join(["usage: swarm COMMAND ...   (swarm COMMAND --help, swarm --version)", "", *lines, ""])


def help_of(verb: str) -> str:
    """The line `HELP` of a verb's module, read from its text: importing all of them takes long."""
    source = Path(__file__).with_name(f"{MODULES.get(verb, verb)}.py").read_text(encoding="utf-8")
    found = _HELP.search(source)
    assert found is not None
    text: str = ast.literal_eval(found[1])
    return text


def _forget_output() -> None:
    """Point stdout to nowhere, or the interpreter would fail once more when it flushes at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
