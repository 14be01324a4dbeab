"""What docs/reference/network/captured-member.md says that a captured member cannot do, tests try."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PAGE = ROOT / "docs/reference/network/captured-member.md"
HEAD = "| it cannot | tests |"

_TEST = re.compile(r"`(tests/[a-z0-9_/]+\.py)::(test_[a-z0-9_]+)`")


def rows() -> list[tuple[str, str]]:
    """What it cannot do, and the cell with its tests."""
    lines = PAGE.read_text().splitlines()
    table = lines[lines.index(HEAD) + 2 :]
    ended = next((number for number, line in enumerate(table) if not line.startswith("|")), len(table))
    return [(cells[0].strip(), cells[1].strip()) for line in table[:ended] if (cells := line.strip("|").split("|"))]


@pytest.mark.parametrize(("cannot", "tests"), rows(), ids=[cannot[:40] for cannot, _ in rows()])
def test_what_a_captured_member_cannot_do_is_tried_by_a_test_that_exists(cannot: str, tests: str) -> None:
    named = _TEST.findall(tests)
    assert named, cannot
    assert ", ".join(f"`{path}::{name}`" for path, name in named) == tests, "nothing but names of tests"
    for path, name in named:
        assert re.search(rf"^def {name}\(", (ROOT / path).read_text(), re.MULTILINE), f"{path} has no {name}"


def test_the_page_lists_what_a_captured_member_cannot_do() -> None:
    assert len(rows()) >= 20
