"""The commands' vocabulary: one word for one thing, held over the whole table of commands."""

import argparse
import contextlib
import importlib
import io
import re
from collections.abc import Iterator

import pytest

from laptop.cli import main
from laptop.cli.commands import SECTIONS
from swarm.onboard import command_line
from swarm.onboard import commands as robot
from swarm.onboard.command_line import Command, CommandGroup

MAKES_ROBOTS = {"sim", "demo", "sweep", "new", "check"}
"""Where `--robots` is a number: no robot has a name yet."""

NOTHING_FOR_PROGRAMS = {
    "new": "it writes a file that a person goes on with",
    "view": "its page is for people; the address ends with Ctrl-C",
    "foxglove": "it serves a program of its own until Ctrl-C",
    "completion": "it prints a script",
    "flash here": "a robot tells how far it is, line by line; the laptop's command has the outcome of all",
    "drive": "a person drives",
    "pad": "its output is keys for another command",
    "calibrate distance": "a person is led through a session",
    "calibrate position": "a person is led through a session",
    "calibrate samples": "a person is led through a session",
    "calibrate check": "a person is led through a session",
    "calibrate fit": "what it finds is written into a file",
    "calibrate offset": "what it finds is written into a file",
}
"""Commands without `--json`, and why."""


def every_command(sections: command_line.Sections) -> Iterator[tuple[str, Command]]:
    for name, each in command_line.commands_of(sections).items():
        if isinstance(each, CommandGroup):
            yield from ((f"{name} {sub}", command) for sub, command in each.commands.items())
        else:
            yield name, each


def leaves(name: str, parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Each verb of a command and its help."""
    verbs = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not verbs:
        yield name, parser.format_help()
    for action in verbs:
        for verb, inner in action.choices.items():
            yield from leaves(name if name.endswith(verb) else f"{name} {verb}", inner)


def said(words: list[str]) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 0
    return out.getvalue()


def helps(name: str, command: Command) -> Iterator[tuple[str, str]]:
    if hasattr(importlib.import_module(command.module), "add_arguments"):
        act = command.first[0] if command.first else ""
        found = list(leaves(name, command_line.parser_of(name, command)))
        mine = [each for each in found if not act or each[0].endswith(act)]
        yield from mine or found
        return
    text = said([*name.split(), "--help"])
    verbs = re.findall(r"^    ([a-z-]+)  ", text, re.MULTILINE) if "COMMAND ..." in text else []
    yield from (
        ((f"{name} {verb}", said([*name.split(), verb, "--help"])) for verb in verbs) if verbs else [(name, text)]
    )


TABLE = [
    pytest.param("flash here" if (where, leaf) == ("robot", "flash") else leaf, text, id=f"{where}: {leaf}")
    for where, sections in (("laptop", SECTIONS), ("robot", robot.SECTIONS))
    for name, command in every_command(sections)
    for leaf, text in helps(name, command)
]


@pytest.mark.parametrize(("name", "text"), TABLE)
def test_a_command_has_the_words_of_all_others(name: str, text: str) -> None:
    assert "--robot " not in text
    if (robots := re.search(r"--robots ([A-Za-z0-9,]+)", text)) is not None:
        wanted = {"N", "N,N"} if name.split()[0] in MAKES_ROBOTS else {"r0,r3"}
        assert robots[1] in wanted
    assert ("--json" in text) != (name in NOTHING_FOR_PROGRAMS)


@pytest.mark.parametrize(("name", "text"), TABLE)
def test_the_help_of_a_command_has_a_description_and_upper_case_arguments(name: str, text: str) -> None:
    _, description, *rest = text.split("\n\n")
    assert description[0].isupper(), name
    arguments = next((part for part in rest if part.startswith("positional arguments:")), "")
    named = re.findall(r"^  ([^ {]+)", arguments, re.MULTILINE)
    assert [each for each in named if not each.partition(".")[0].isupper()] == [], name


def test_what_has_no_output_for_programs_is_a_command() -> None:
    assert set(NOTHING_FOR_PROGRAMS) <= {param.values[0] for param in TABLE}


def test_a_laptop_has_every_command_of_a_robot() -> None:
    assert {name for name, _ in every_command(robot.SECTIONS)} <= {name for name, _ in every_command(SECTIONS)}


def test_hands_and_measurements_are_complete() -> None:
    groups = {name: each for name, each in command_line.commands_of(SECTIONS).items() if isinstance(each, CommandGroup)}
    assert list(groups["hand"].commands) == [
        "press", "push", "lay", "place", "lift", "roll", "miswire", "unplug", "kill", "cut", "reboot",
    ]  # fmt: skip
    assert list(groups["measure"].commands) == ["rtt", "throughput", "rssi", "radio", "i2c"]
