"""Arguments that many commands have in common, and the types of what is given for them."""

import argparse
import contextlib
import difflib
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO

from swarm.messages.keys import is_name
from swarm.process.terminal import write_lines

PICTURES = (".png", ".pdf", ".svg")
"""Endings of pictures' names."""


class HintingParser(argparse.ArgumentParser):
    """A parser that names the option that is spelled like an unknown one."""

    def error(self, message: str) -> NoReturn:
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message:
            known = list(self._option_string_actions)
            words = [word.partition("=")[0] for word in unknown.split() if word.startswith("--")]
            near = [each for word in words for each in difflib.get_close_matches(word, known, n=1)]
            message += f"; did you mean {near[0]}?" if near else ""
        super().error(message)


class CommandParser(HintingParser):
    """A parser that takes words behind options, too, as in `swarm replay RUN --json KEY`, and refuses words that are
    left. For the words of a verb argparse has the parser above it do so, with a usage that is not the verb's."""

    _behind_options = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = sys.argv[1:] if args is None else list(args)
        found, rest = super().parse_known_args(words, namespace)
        if self._behind_options or not rest:
            return found, rest
        if self._subparsers is None and "--" not in words:
            self._behind_options = True
            try:
                found, rest = self.parse_known_intermixed_args(words)
            finally:
                self._behind_options = False
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return found, rest


def add_json(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def show(args: argparse.Namespace, data: object, lines: Iterable[str]) -> None:
    """Write what a command has found: `data` as JSON where `--json` was given, else `lines` for people."""
    write_lines([json.dumps(data)] if args.json else lines)


@contextlib.contextmanager
def json_alone(as_json: bool) -> Iterator[TextIO]:
    """Yield standard output. With `as_json` everything else that is printed within this, also by an app that is being
    imported, goes to standard error."""
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr if as_json else out):
        yield out


def add_robots(parser: argparse._ActionsContainer, text: str) -> None:
    """Declare `--robots r0,r3`, which may be repeated; `args.robots` is a list of names, or None."""
    parser.add_argument("--robots", action="extend", type=names, metavar="r0,r3", help=text)


def add_run_dir(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--run-dir", type=Path, metavar="DIR", help="run directory of the simulation (its --run-dir)")


def names(text: str) -> list[str]:
    """Return names of robots from a list like r0,r3."""
    found = [name for name in text.split(",") if name]
    if not found or not all(map(is_name, found)):
        raise argparse.ArgumentTypeError(f"{text!r}: expected names of robots, like r0,r3")
    return list(dict.fromkeys(found))


def picture(text: str, endings: Sequence[str] = PICTURES) -> Path:
    """Return the path of a picture that is to be drawn into a folder that is there, as `picture_name` does. What is
    wrong with it is said before anything is computed."""
    path = picture_name(text, endings)
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r}: there is no folder {path.parent}")
    return path


def picture_name(text: str, endings: Sequence[str] = PICTURES) -> Path:
    """Return the path of a picture, whose name has one of these endings; a name without one gets that of PNG."""
    path = Path(text) if Path(text).suffix else Path(f"{text}.png")
    if path.suffix.lower() not in endings:
        raise argparse.ArgumentTypeError(f"{text!r}: a picture is a file that ends in {', '.join(endings)}")
    return path


def number(
    least: float = -math.inf, most: float = math.inf, unit: str = "", *, above: bool = False
) -> Callable[[str], float]:
    """Return the type of a finite number, from `least` to `most`; with `above` it is more than `least`."""
    wanted = f"{least:g} or more" if most == math.inf else f"{least:g} to {most:g}"
    if least == -math.inf:
        wanted = "a finite number"
    if above:
        wanted = f"a number above {least:g}"

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if math.isfinite(value) and least <= value <= most and not (above and value == least):
            return value
        raise argparse.ArgumentTypeError(f"{text!r}: expected {wanted} {unit}".rstrip())

    return parse


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Return the type of a whole number from `least` to `most`."""
    wanted = f"{least} or more, a whole number" if most is None else f"a whole number from {least} to {most}"

    def parse(text: str) -> int:
        if text.isascii() and text.isdecimal() and least <= int(text) and (most is None or int(text) <= most):
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r}: expected {wanted}")

    return parse


def sizes(most: int | None = None) -> Callable[[str], tuple[int, ...]]:
    """Return the type of a list of numbers of bytes, like 1,8,28."""
    one = whole(1, most)
    return lambda text: tuple(dict.fromkeys(map(one, text.split(","))))
