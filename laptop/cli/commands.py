"""The table of all commands of `swarm`: names, groups, and the module behind each."""

import ast
import re
from pathlib import Path
from typing import NamedTuple


class Command(NamedTuple):
    """One command: a module, or a program."""

    module: str
    """It has `HELP`, `add_arguments(parser)` and `run(args) -> int`, or `main()`, which reads `sys.argv`."""
    first: tuple[str, ...] = ()
    """Arguments that come before those that the user gives."""
    help: str = ""
    """One line; empty where the module has it as `HELP`."""


class CommandGroup(NamedTuple):
    """Commands under one word, as in `swarm hand press`."""

    help: str
    commands: dict[str, Command]
    alone: str = ""
    """The command that is meant where none is named; empty: one must be named."""


SECTIONS: dict[str, dict[str, Command | CommandGroup]] = {
    "write an app, simulate it, look at runs": {
        "new": Command("sim.rehearsal.new", help="write a commented app and its test"),
        "check": Command("sim.rehearsal.check", help="examine an app before any robot moves: size, time, convergence"),
        "sim": Command("laptop.cli.runs.sim", help="simulate a swarm of real service processes, or in virtual time"),
        "demo": Command("laptop.cli.runs.sim", ("--demo",), "three simulated robots find a target, in under a minute"),
        "sweep": Command("laptop.cli.runs.sweep", help="run an app over parameters, topologies and seeds"),
        "plot": Command("laptop.cli.runs.plot"),
        "view": Command("laptop.cli.runs.view"),
        "film": Command("laptop.cli.runs.film"),
        "replay": Command("laptop.cli.runs.replay"),
        "export": Command("laptop.cli.runs.export"),
        "import": Command("laptop.cli.runs.import_csv"),
    },
    "a running swarm": {
        "hand": CommandGroup(
            "do to simulated robots what a person can do",
            {name: Command(f"laptop.cli.hand.{name}") for name in ("press", "push", "lay", "unplug", "kill", "reboot")},
        ),
        "mesh": CommandGroup(
            "the robots and their links, the topology, the members of runs",
            {
                "show": Command("laptop.cli.mesh.show"),
                "topology": Command("laptop.cli.mesh.topology"),
                "epoch": Command("laptop.cli.mesh.epoch"),
            },
            alone="show",
        ),
        "measure": CommandGroup(
            "links, paths and the I2C bus",
            {
                "rtt": Command("laptop.cli.measure.links", ("rtt",), "round-trip times by payload size and overlay"),
                "throughput": Command("laptop.cli.measure.links", ("throughput",), "bytes a second of links and paths"),
                "rssi": Command("laptop.cli.measure.links", ("rssi",), "signal strength of a Bluetooth link"),
                "i2c": Command("laptop.cli.measure.i2c"),
            },
        ),
        "app": CommandGroup(
            "apps while they run",
            {
                "start": Command("laptop.cli.app.simulated", ("start",), "start an app beside those that run"),
                "stop": Command("laptop.cli.app.simulated", ("stop",), "stop an app"),
                "param": Command("laptop.cli.app.param"),
            },
        ),
        "dwm": Command("services.dwm.tool", help="look at UWB modules, set them up, find what is wrong"),
        "calibrate": Command("services.dwm.calibrate.__main__", help="calibrate the UWB module of a robot"),
        "discover": Command("services.mesh.discover", help="list Bluetooth devices in range, and which are robots"),
        "config": Command("laptop.cli.robots.config"),
        "key": Command("laptop.cli.robots.key"),
    },
    "real robots, over ssh": {
        "provision": Command("laptop.cli.robots.provision"),
        "pair": Command("laptop.cli.robots.pair"),
        "bundle": Command("laptop.cli.robots.bundle"),
        "deploy": Command("laptop.cli.robots.deploy"),
        "run": Command("laptop.cli.robots.run"),
        "status": Command("laptop.cli.robots.status"),
        "logs": Command("laptop.cli.robots.logs"),
        "fetch": Command("laptop.cli.robots.fetch"),
        "flash": Command("laptop.fleet.flash", help="put new firmware on the Balboas, over their USB cables"),
        "doctor": Command("laptop.cli.robots.doctor"),
        "command": Command("laptop.cli.robots.command"),
        "services": CommandGroup(
            "services and apps",
            {
                "start": Command("laptop.fleet.control", ("start",), "start services or apps of all robots"),
                "stop": Command("laptop.fleet.control", ("stop",), "stop services or apps of all robots"),
                "restart": Command("laptop.fleet.control", ("restart",), "restart services or apps of all robots"),
            },
        ),
    },
    "safety": {
        "estop": Command("laptop.cli.stop.estop"),
        "stop": Command("laptop.cli.stop.estop", help="the same as estop"),
        "arm": Command("laptop.cli.stop.arm"),
    },
    "this shell": {
        "completion": Command("laptop.cli.completion"),
    },
}

COMMANDS: dict[str, Command | CommandGroup] = {
    name: each for section in SECTIONS.values() for name, each in section.items()
}

_ROOT = Path(__file__).parents[2]
"""Where the packages lie."""

_HELP = re.compile(r'^HELP = (".*")$', re.MULTILINE)


def names() -> list[str]:
    """Return every command as it is typed behind `swarm`, groups with each of their commands."""
    found: list[str] = []
    for name, each in COMMANDS.items():
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


def usage() -> str:
    """Return what `swarm --help` prints: one line for each command, at most 100 characters wide."""
    lines = ["usage: swarm COMMAND ...   (swarm COMMAND --help, swarm --version)"]
    for title, section in SECTIONS.items():
        lines += ["", f"{title}:"]
        lines += [_line(name, each) for name, each in section.items()]
    return "\n".join([*lines, ""])


def usage_of(name: str, group: CommandGroup) -> str:
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
    return f"  {name:<10} {text}"
