"""Several commands of a robot's shell in one, and its output taken apart again."""

from collections.abc import Mapping

_MARK = "== "


def ask(commands: Mapping[str, str]) -> str:
    """Return the command that prints the output of each of `commands` below its name. It always succeeds."""
    return "; ".join([*(f"echo '{_MARK}{name}'; {command}" for name, command in commands.items()), "true"])


def read(text: str) -> dict[str, str]:
    """Return the output of each command by its name."""
    return {name: output.strip() for name, _, output in (part.partition("\n") for part in text.split(_MARK)[1:])}
