"""The check that names keep to the glossary finds each kind of breach, and cannot pass without having read."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("glossary_check", ROOT / "tools" / "glossary.py")
assert _spec is not None
assert _spec.loader is not None
check = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(check)

PAGE = (ROOT / check.PAGE).read_text()


def found(page=PAGE, **modules):
    extra = {f"swarm/app/{name}.py": text for name, text in modules.items()}
    good = {f"swarm/{'app/' * number}run.py": "x = 1\n" for number in range(check.FEWEST_MODULES)}
    return check.breaches(page, good | extra)


def test_the_tree_keeps_to_the_glossary() -> None:
    assert check.main() == 0


KINDS = (
    "tape = 1",
    "def play_tape(): pass",
    "class TapeReader: pass",
    "def f(tape): pass",
    "import os as tape",
    "from os import path as tape",
    "try: pass\nexcept OSError as tape: pass",
    *(f"match x:\n case {pattern}: pass" for pattern in ("int() as tape", "[*tape]", "{1: 2, **tape}")),
)


@pytest.mark.parametrize("text", KINDS)
def test_a_replaced_word_is_found_in_every_kind_of_identifier(text: str) -> None:
    assert any("'tape' is now: trajectory builder" in line for line in found(app=text))


def test_a_module_named_by_an_unknown_word_is_found() -> None:
    assert any("'gizmo' is neither" in line for line in found(gizmo=""))


def test_a_replaced_word_inside_another_word_is_no_breach() -> None:
    assert not any("is now" in line for line in found(app="think, taped = 1, 2"))


def test_a_page_or_a_tree_that_cannot_be_read_does_not_pass() -> None:
    assert any("too few" in line for line in check.breaches("# Glossary", {}))
    assert any("modules were found" in line for line in check.breaches(PAGE, {}))


def test_terms_out_of_order_are_found() -> None:
    lines = PAGE.splitlines()
    at = next(number for number, line in enumerate(lines) if line.startswith("| air |"))
    lines[at], lines[at + 1] = lines[at + 1], lines[at]
    assert any("alphabetical" in line for line in found("\n".join(lines)))
