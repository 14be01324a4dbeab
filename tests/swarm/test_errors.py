"""Messages about a package that is not installed name an extra that has it."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

from swarm.errors import MissingPackageError

ROOT = Path(__file__).parents[2]
SOURCES = [path for folder in ("swarm", "services", "sim", "laptop") for path in sorted((ROOT / folder).rglob("*.py"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def packages_of(extra: str) -> set[str]:
    """The packages that an extra installs, by name."""
    found = {re.split(r"[<>=\[]", each, maxsplit=1)[0] for each in PROJECT["optional-dependencies"][extra]}
    return found | (packages_of("lab") if "balboa-swarm" in found else set())


def messages() -> list[tuple[str, str | None, list[str]]]:
    """Where such an error is raised, the package that it names (None: told at run time), and the extras."""
    found = []
    for path in SOURCES:
        text = path.read_text()
        if "MissingPackageError(" not in text:  # each test process would spend a second on the others
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "MissingPackageError":
                words = [each.value if isinstance(each, ast.Constant) else None for each in node.args]
                extras = [str(word) for word in words[2:] if word is not None]
                found.append((f"{path.relative_to(ROOT)}:{node.lineno}", words[1], extras))
    return found


@pytest.mark.parametrize(("place", "package", "extras"), messages())
def test_the_extra_that_is_named_has_the_package(place: str, package: str | None, extras: list[str]) -> None:
    for extra in extras:
        assert extra in PROJECT["optional-dependencies"], place
        assert package is None or package in packages_of(extra), place


def test_no_other_message_names_an_extra() -> None:
    named = [path for path in SOURCES if "balboa-swarm[" in path.read_text()]
    assert [str(path.relative_to(ROOT)) for path in named] == ["swarm/errors.py"]


def test_a_message_names_the_extra_of_a_laptop_and_that_of_a_robot() -> None:
    assert str(MissingPackageError("a serial port", "pyserial", "lab", "robot")) == (
        'a serial port needs pyserial: pip install "balboa-swarm[lab]" (on a robot: "balboa-swarm[robot]")'
    )
