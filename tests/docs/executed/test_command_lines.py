"""Command lines of all pages: each is one that the command takes."""

import argparse
import contextlib
import importlib
import re
import shlex
from pathlib import Path
from typing import NoReturn

import pytest
from documented_path import FENCE, blocks

from laptop.cli import far
from laptop.cli.commands import SECTIONS
from sim.scenario import options as simulation
from swarm.onboard.command_line import Command, CommandGroup, commands_of, parser_of, with_verb

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
INDENTED = re.compile(r"^ {4}((?:\./run )?swarm (?:.*\\\n)*.*)$", re.MULTILINE)
COMMANDS = commands_of(SECTIONS)
PLACEHOLDER = re.compile(r"\b(?:NAME_OR_FILE|RUN|DIR|HOST|ID|KIND)\b|\[--|<\w+>|\.\.\.")


def lines_of(page: Path) -> list[str]:
    """The commands `swarm` of a page as they are typed, in their order, each without what comes before `swarm`."""
    fenced = [block.text for block in blocks(page) if block.language == "sh"]
    indented = INDENTED.findall(FENCE.sub("", page.read_text(encoding="utf-8")))
    lines = "\n".join(fenced + indented).replace("\\\n", " ").splitlines()
    parts = [part.strip() for line in lines for part in re.split(r";|&&|\|", re.sub(r"(^|\s)#.*", "", line))]
    typed = [part.removeprefix("./run ").rstrip("& ") for part in parts]
    return [line for line in typed if line.startswith("swarm ") and not PLACEHOLDER.search(line)]


TYPED = [(str(page.relative_to(ROOT)), line) for page in PAGES for line in dict.fromkeys(lines_of(page))]


class _Refused(Exception):
    pass


def refuse(parser: argparse.ArgumentParser, message: str) -> NoReturn:
    raise _Refused(f"{parser.prog}: {message}")


def parsed(words: list[str]) -> None:
    """Have the command's own parser read its words."""
    name, *rest = words
    command: Command | CommandGroup | None = COMMANDS.get(name)
    assert command is not None or name == "--version", f"no command {name}"
    if isinstance(command, CommandGroup):
        chosen = rest.pop(0) if rest and rest[0] in command.commands else command.alone
        assert chosen, f"{name} {rest}"
        name, command = f"{name} {chosen}", command.commands[chosen]
    if command is None or name == "demo":
        return
    if name == "sim":
        simulation.parse(rest)
        return
    rest = with_verb(command, rest)
    if not hasattr(importlib.import_module(command.module), "add_arguments"):
        return
    if command.far:  # what leads to real robots is taken off before the command reads its words
        _, rest = far.reader(name).parse_known_args(rest)
    parser_of(name, command).parse_args([*command.first, *rest])


def test_there_are_command_lines() -> None:
    assert len(TYPED) > 150


@pytest.mark.parametrize(("page", "line"), TYPED)
def test_a_command_line_is_one_that_the_command_takes(page: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(argparse.ArgumentParser, "error", refuse)
    with contextlib.suppress(SystemExit):  # --help
        parsed(shlex.split(line)[1:])
