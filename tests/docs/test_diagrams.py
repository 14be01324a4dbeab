"""Diagrams are SVG files: readable in light and dark, and on a narrow screen."""

import re
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.browsing import chromium

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
DIAGRAMS = sorted((DOCS / "images" / "diagrams").glob("*.svg"))
SVG = "{http://www.w3.org/2000/svg}"
WIDEST = 440
"""Units of a picture's width: text of 14 units is 11 px high on a screen of 390 px."""
DRAWN = re.compile(r"[\u2500-\u257f]|--+>|<--+|^    +\w.*->", re.MULTILINE)
"""Boxes and arrows made of characters."""


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(DOCS)))
def test_no_diagram_is_drawn_with_characters(page: Path) -> None:
    assert DRAWN.findall(page.read_text(encoding="utf-8").replace("<!--", "").replace("-->", "")) == []


@pytest.mark.parametrize("path", DIAGRAMS, ids=lambda path: path.name)
def test_a_diagram_has_a_title_a_page_and_dark_colours(path: Path) -> None:
    root = ElementTree.parse(path).getroot()
    assert root.findtext(f"{SVG}title")
    assert int(root.attrib["viewBox"].split()[2]) <= WIDEST
    assert "prefers-color-scheme: dark" in str(root.findtext(f"{SVG}style"))
    assert any(f"diagrams/{path.name})" in page.read_text(encoding="utf-8") for page in PAGES)


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    with chromium() as browser:
        yield browser.new_page()


@pytest.mark.slow
@pytest.mark.parametrize("path", DIAGRAMS, ids=lambda path: path.name)
def test_texts_of_a_diagram_fit_and_do_not_cover_each_other(page: Any, path: Path) -> None:
    page.goto(path.as_uri())
    found = page.evaluate(
        "[...document.querySelectorAll('text')].map(each => {"
        "const {x, y, width, height} = each.getBBox(); return [x, y, x + width, y + height, each.textContent]})"
    )
    _, _, right, bottom = map(float, ElementTree.parse(path).getroot().attrib["viewBox"].split())
    for x, y, end, foot, text in found:
        assert x >= 4, text
        assert y >= 0, text
        assert end <= right - 4, text
        assert foot <= bottom, text
    for a, b in combinations(found, 2):
        apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] + 4 or b[3] <= a[1] + 4
        assert apart, (a[4], b[4])
