"""The lockstep chart, in a real browser: a link of a line is cut, and robots wait for each other."""

import re
from pathlib import Path
from typing import Any

import pytest
from browsing import PATIENCE_MS, seek, shown, until
from virtual_run import recorded

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

pytest_plugins = ("view_fixtures",)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
PICTURE = """(() => {
  const canvas = document.querySelector("#lockstep canvas");
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let red = 0;
  for (let i = 0; i < data.length; i += 4) {
    red += [0xc0, 0x26, 0x2d].every((each, at) => Math.abs(data[i + at] - each) < 15) && data[i + 3] > 200;
  }
  return red;
})()"""
"""How many pixels are in the colour of what is bad."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    recorded(folder, "consensus", "--robots", "6", "--topology", "line", "--seconds", "12", "--cut", "r2-r3@2s,6s")
    return folder


def test_the_lockstep_chart_says_and_shows_which_robot_waits_for_which(browser: Any, run: Path) -> None:
    with shown(browser, run, color_scheme="light") as page:
        seek(page, 6)
        said = page.locator("#lockstep p")
        waits = "r2 waits for r3 (link down); r3 waits for r2 (link down); 4 robots wait behind them"
        expect(said).to_have_text(re.compile(rf"iterations \d+ to \d+; {re.escape(waits)}"), timeout=PATIENCE_MS)
        until(page, f"{PICTURE} > 300")
        seek(page, 1.5)
        expect(said).to_have_text(re.compile(r"all at iteration \d+"), timeout=PATIENCE_MS)
        until(page, f"{PICTURE} === 0")


def test_a_column_is_a_robot(browser: Any, run: Path) -> None:
    with shown(browser, run) as page:
        seek(page, 6)
        canvas = page.locator("#lockstep canvas")
        box = canvas.bounding_box(timeout=PATIENCE_MS)
        until(page, f"{PICTURE} > 300")
        canvas.click(position={"x": box["width"] - 60, "y": 100})
        expect(page.locator("#keys h2")).to_have_text("swarm/r5")


def test_what_an_app_names_goes_before_what_one_can_see(browser: Any, run: Path) -> None:
    """A live app says for whom it waits; here its word is put into the page."""
    with shown(browser, run) as page:
        seek(page, 6)
        page.evaluate(
            "swarmView.store.take({t: 6, live: true, robots: {r0: {'app/consensus/progress': "
            "{phase: 'waiting', k: 69, waiting_for: ['r5'], reason: ''}}}}, performance.now())"
        )
        expect(page.locator("#lockstep p")).to_contain_text("4 robots wait behind them", timeout=PATIENCE_MS)
        assert page.evaluate("swarmView.lockstepChart.waits(swarmView.lockstepChart.iterations()).get('r0')") == [
            {"peer": "r5", "named": True}
        ]
