"""The page against WCAG 2.2 AA, as axe-core finds what a program can find: light, dark, a desk and a phone."""

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from browsing import PATIENCE_MS, seek, shown, until
from virtual_run import recorded

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
axe = pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed")
expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

pytest_plugins = ("view_fixtures",)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]

LEVELS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]
ACTS = "swarmView.store.swarm.acts = ['stop', 'arm', 'mode', 'set', 'start', 'end', 'drive', 'cut', 'kill', 'push']"

FOUND = """([where, levels]) => axe.run(where, {runOnly: {type: "tag", values: levels}}).then(({violations}) =>
  violations.flatMap(({id, nodes}) => nodes.map(({target, failureSummary}) => `${id} ${target}: ${failureSummary}`)))"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six robots in lockstep, of which two lose each other at 2 s: there is trouble to be shown."""
    folder = tmp_path_factory.mktemp("runs") / "waits"
    recorded(folder, "consensus", "--robots", "6", "--topology", "line", "--seconds", "9", "--cut", "r2-r3@2s,60s")
    return folder


@pytest.fixture(params=["light", "dark"])
def scheme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=[(1440, 900), (390, 844)], ids=["desk", "phone"])
def page(browser: Any, run: Path, scheme: str, request: pytest.FixtureRequest) -> Iterator[Any]:
    width, height = request.param
    with shown(browser, run, viewport={"width": width, "height": height}, color_scheme=scheme) as page:
        seek(page, 8)
        expect(page.locator("[data-answer=held] b")).to_contain_text("r2–r3 down", timeout=PATIENCE_MS)
        page.evaluate((files(axe) / "axe.min.js").read_text(encoding="utf-8"))
        yield page


def found(page: Any, where: str = "html") -> list[str]:
    """What violates WCAG AA in a part of the page, in words."""
    violations: list[str] = page.evaluate(FOUND, [where, LEVELS])
    return violations


def test_nothing_violates_wcag_aa(page: Any) -> None:
    assert found(page) == []
    page.evaluate(ACTS)
    page.evaluate("swarmView.select('r1')")
    expect(page.locator("#control")).to_be_visible(timeout=PATIENCE_MS)
    until(page, "document.querySelectorAll('#controls button').length > 4")
    assert found(page) == []
    page.evaluate("swarmView.layout.arrange()")
    assert found(page, "#arrange") == []
    page.keyboard.press("Escape")
    expect(page.locator("#arrange")).to_be_hidden()
    page.keyboard.press("Control+k")
    expect(page.locator("#finder")).to_be_visible()
    assert found(page, "#finder") == []
