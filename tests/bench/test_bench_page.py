"""The page of results has the rows that the areas define, or says that a table was measured with others."""

import ast
import inspect
import re
from collections.abc import Iterator
from types import ModuleType

import pytest

from bench import __main__ as program
from bench import page
from bench.__main__ import AREAS

OLDER = "The area has other rows or limits today."
"""Stands in a table that was measured before its area became what it is; `./run bench AREA --write` replaces both."""
ANY = ".*"

Defined = list[tuple[str, str | None]]
"""A pattern of a row's name, and its limit as the page shows it, where that is known without a run."""


def modules(area: str) -> set[ModuleType]:
    """The module of an area, and those of its folder that it takes something from."""
    module = program.area_module(area)
    sources = {inspect.getmodule(value) for value in vars(module).values()} - {None, module}
    return {module} | {each for each in sources if each.__name__.startswith(f"{module.__package__}.")}


def pattern(name: ast.expr, texts: dict[str, list[ast.expr]]) -> str:
    """What a row's name looks like; `texts` has the values that each name of the module is given."""
    if isinstance(name, ast.Constant):
        return re.escape(str(name.value))
    if isinstance(name, ast.JoinedStr):
        return "".join(pattern(part, texts) for part in name.values)
    values = texts.get(ast.unparse(name.value if isinstance(name, ast.FormattedValue) else name), [])
    return pattern(values[0], texts) if len(values) == 1 else ANY


def defined(module: ModuleType) -> Iterator[tuple[str, str | None]]:
    """The rows of a module. A name that only a run makes may be any text of the module."""
    nodes = list(ast.walk(ast.parse(inspect.getsource(module))))
    texts: dict[str, list[ast.expr]] = {}
    for node in nodes:
        if isinstance(node, ast.Assign):
            texts.setdefault(ast.unparse(node.targets[0]), []).append(node.value)
    for node in nodes:
        if not (isinstance(node, ast.Call) and ast.unparse(node.func) == "Row"):
            continue
        name = pattern(node.args[0], texts)
        if name != ANY:
            yield name, limit(node, module)
        else:
            found = (pattern(each, texts) for each in nodes if isinstance(each, ast.Constant | ast.JoinedStr))
            yield from ((text, None) for text in found if re.search("[a-z]", text))


def limit(row: ast.Call, module: ModuleType) -> str | None:
    """The limit of a row that is made of the module's constants alone."""
    try:
        return f"{eval(ast.unparse(row.args[3]), dict(vars(module))):.4g}"
    except (IndexError, NameError):
        return None


def strange(cells: list[str], rows: Defined) -> str | None:
    """What is wrong with a line of a table, its cells given. A row that goes on with the one above it begins with two
    spaces, which a cell does not have."""
    limits = {limit for name, limit in rows if any(re.fullmatch(name, it) for it in (cells[0], f"  {cells[0]}"))}
    if not limits:
        return f"no row {cells[0]!r}"
    if None not in limits and cells[3] not in limits:
        return f"{cells[0]!r} has the limit {cells[3]}, not {limits}"
    return None


@pytest.mark.parametrize("area", AREAS)
def test_a_table_has_the_rows_and_limits_of_its_area_or_says_that_it_has_not(area: str) -> None:
    text = page.PAGE.read_text(encoding="utf-8")
    part = text[text.index(f"<!-- bench {area} -->") : text.index(f"<!-- end of bench {area} -->")]
    head, _, table = part.partition(page.HEAD)
    rows = [row for module in modules(area) for row in defined(module)]
    lines = [re.split(r" *(?<!\\)\| *", line)[1:] for line in table.strip().splitlines()]
    found = list(filter(None, (strange(cells, rows) for cells in lines)))
    if OLDER in " ".join(head.split()):
        assert found, f"take `{OLDER}` out of the table of {area}"
    else:
        assert not found, f"write it anew by `./run bench {area} --write`, or say in it: {OLDER}"


HUB_ROWS = {
    "the link r0-r3 loses 60 % of its packets": "weak link r0-r3",
    "r0 stands in a poor place: 50 %": "r0 in a poor place",
    "r0 does not hear r5": "r0 does not hear r5",
    "r3 stands in a poor place: 60 %": "r3 in a poor place",
}
"""Rows of the page of the hub, and how the names of their rows of results begin."""


@pytest.mark.parametrize("row", HUB_ROWS)
def test_the_page_of_the_hub_has_the_results_of_the_slot_radio(row: str) -> None:
    results = page.PAGE.read_text(encoding="utf-8")
    expected = []
    for graph in ("line 6", "thesis-d 6", "full 6"):
        name = rf"\| {HUB_ROWS[row]}, links = {{}}, {graph}, beside star \| (\S+) \| ms \| (\S+) \|"
        by_graph, by_auto = (re.search(name.format(links), results) for links in ("graph", r"auto \(r\d\)"))
        assert by_graph is not None
        assert by_auto is not None
        expected += [by_graph[1], by_graph[2], by_auto[1]]
    told = page.PAGE.parent.parent / "explanation/hub.md"
    (line,) = [each for each in told.read_text(encoding="utf-8").splitlines() if each.startswith(f"| {row} |")]
    assert line.strip("| ").split(" | ")[1:] == [f"{float(each):.0f}" for each in expected]


def test_rows_that_are_gone_and_limits_that_have_changed_are_found() -> None:
    rows: Defined = [(r"start of .+ robots", "6"), (r"all links", None)]
    assert strange(["start of 6 robots", "1", "s", "6"], rows) is None
    assert strange(["all links", "1", "s", "9"], rows) is None
    assert "no row 'stop'" in str(strange(["stop", "1", "s", "6"], rows))
    assert "has the limit 60" in str(strange(["start of 6 robots", "1", "s", "60"], rows))
