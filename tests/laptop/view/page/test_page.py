"""The page in a real browser, with a real simulation behind it."""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import PATIENCE_MS, View, event, row, seek, shown, until, visit
from conftest import wait_until
from virtual_run import recorded

from bench.rigs.simulation import Simulation

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
expect = sync_api.expect

MIDDLE = """(() => {
  const { map } = swarmView, { left, top } = map.canvas.getBoundingClientRect(), { width, height } = map.canvas;
  const all = [...map.placed.values()], mean = (axis) => all.reduce((sum, each) => sum + each[axis], 0) / all.length;
  const { x, y, scale } = map.shown, [right, up] = [(mean("x") - x) * scale, (mean("y") - y) * scale];
  return [left + (width / 2 + right) / map.ratio, top + (height / 2 - up) / map.ratio];
})()"""
"""Where on the screen the middle between all robots is."""

pytest_plugins = ("view_fixtures",)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


@pytest.fixture(scope="module")
def simulation() -> Iterator[Simulation]:
    with Simulation("consensus", "--robots", "6", "--topology", "loop", "--seconds", "3600") as simulation:
        simulation.wait_for("r0", 3)
        # Six bodies fall in real time where a busy machine holds up their loops while everything starts.
        stand = [sys.executable, "-m", "laptop.cli", "balance", "stand", "--run-dir", str(simulation.run_dir)]
        wait_until(lambda: subprocess.run(stand, capture_output=True, check=False).returncode == 0, what="all stand")
        yield simulation


@pytest.fixture(scope="module")
def views(simulation: Simulation) -> Iterator[Callable[..., View]]:
    """One server for all tests with the same options."""
    made: dict[tuple[str, ...], View] = {}

    def view(*options: str) -> View:
        if options not in made:
            made[options] = View("--run-dir", simulation.run_dir, *options)
        return made[options]

    yield view
    for each in made.values():
        each.close()


@pytest.fixture
def page(browser: Any, views: Callable[..., View], request: pytest.FixtureRequest) -> Iterator[Any]:
    with visit(browser, views(*getattr(request, "param", ()))) as page:
        yield page


def test_the_page_shows_six_robots_that_converge(page: Any) -> None:
    expect(page.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)
    expect(page.locator("tbody tr")).to_have_count(6)
    for robot in ("r0", "r3", "r5"):
        expect(row(page, robot)).to_contain_text("balancing", timeout=PATIENCE_MS)
        expect(row(page, robot)).to_contain_text("2/2", timeout=PATIENCE_MS)
        expect(row(page, robot)).to_contain_text("consensus running", timeout=PATIENCE_MS)
        expect(row(page, robot)).to_contain_text(re.compile(r"\d\.\d\d V \d+ min.* ±\d+\.\d ms by r0\d ok"))
    row(page, "r2").click()
    expect(page.locator("#keys h2")).to_have_text("swarm/r2")
    value = page.locator("#keys button", has_text=re.compile(r"^state\.value=2\.58"))
    expect(value).to_be_visible(timeout=PATIENCE_MS)
    value.click()
    expect(page.locator("#values select")).to_have_value("app/consensus/state state.value", timeout=PATIENCE_MS)
    until(page, "swarmView.values.chart.plot.lines?.length === 6")


def test_a_reload_loses_nothing(page: Any) -> None:
    expect(row(page, "r0")).to_contain_text("consensus", timeout=PATIENCE_MS)
    places = page.evaluate("[...swarmView.store.places.keys()].length")
    page.reload()
    expect(row(page, "r0")).to_contain_text("consensus", timeout=PATIENCE_MS)
    until(page, f"swarmView.store.places.size >= {places}")


def test_without_control_there_is_nothing_to_press_and_nothing_is_done(page: Any) -> None:
    expect(page.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)
    expect(page.locator("#stop")).to_be_hidden()
    row(page, "r0").click()
    expect(page.locator("#controls")).to_be_hidden()


@pytest.mark.parametrize("page", [("--control",)], indirect=True)
def test_a_cut_link_turns_red_and_mends(page: Any) -> None:
    row(page, "r0").click(timeout=PATIENCE_MS)
    page.get_by_role("button", name="cut r1").click(timeout=PATIENCE_MS)
    until(page, "swarmView.store.link('r0', 'r1')?.state === 'down'")
    expect(event(page, "r0", "link down")).to_be_visible(timeout=PATIENCE_MS)
    expect(row(page, "r0")).to_contain_text("1/2", timeout=PATIENCE_MS)
    page.get_by_role("button", name="mend r1").click()
    until(page, "swarmView.store.link('r0', 'r1')?.state === 'up'")
    expect(row(page, "r0")).to_contain_text("2/2", timeout=PATIENCE_MS)


@pytest.mark.parametrize("page", [("--control",)], indirect=True)
def test_a_killed_service_is_named_and_comes_back(page: Any) -> None:
    row(page, "r4").click(timeout=PATIENCE_MS)
    page.get_by_role("button", name="kill dwm").click(timeout=PATIENCE_MS)
    expect(event(page, "r4", "dwm is gone")).to_be_visible(timeout=PATIENCE_MS)
    expect(event(page, "r4", "dwm is back")).to_be_visible(timeout=PATIENCE_MS)


@pytest.mark.parametrize("page", [("--control",)], indirect=True)
def test_a_goal_on_the_map_is_the_first_place_that_a_robot_drives_to(page: Any) -> None:
    row(page, "r2").click(timeout=PATIENCE_MS)
    page.evaluate(
        "const {store} = swarmView, take = store.take.bind(store); globalThis.told = [];"
        "store.take = (step, now) => { take(step, now); const each = step.robots?.r2?.['app/goto/parameters'];"
        " if (each) told.push(each.parameters.waypoints.value); }; 0"
    )
    until(page, "swarmView.map.placed?.size === 6 && swarmView.map.canSend && swarmView.selected === 'r2'")
    x, y = page.evaluate(MIDDLE)
    page.mouse.click(x, y)
    page.locator("#send-goal").click(timeout=PATIENCE_MS)
    goal = page.evaluate("({ ...swarmView.map.wanted })")
    until(page, "told.length > 0")
    place = "swarmView.store.pose('r2')"
    until(page, f"Math.hypot({place}.x - {goal['x']}, {place}.y - {goal['y']}) < 0.15")
    assert set(page.evaluate("told")) == {f"{goal['x']:.3f},{goal['y']:.3f} stay"}
    told = "swarmView.store.get('r0', 'app/goto/parameters').parameters.waypoints.value"
    assert page.evaluate(told) == "stay"
    page.get_by_role("button", name="stop goto on all").click()
    until(page, "swarmView.store.names.every((name) => !swarmView.store.services[name]['app/goto'])")


@pytest.mark.parametrize("page", [("--control",)], indirect=True)
def test_hands_are_laid_on_a_robot(page: Any) -> None:
    # Whether it stands is not asked: six bodies fall in real time, also where a busy machine holds up their loops.
    row(page, "r3").click(timeout=PATIENCE_MS)
    page.get_by_role("button", name="press C").click(timeout=PATIENCE_MS)
    until(page, "swarmView.store.get('r3', 'balancer/buttons')?.presses_c >= 1")
    page.get_by_role("button", name="push").click()
    expect(page.locator("#said")).to_contain_text("r3: pushed", timeout=PATIENCE_MS)
    page.get_by_role("button", name="lay on back").click()
    expect(event(page, "r3", "fault: fell")).to_be_visible(timeout=PATIENCE_MS)
    expect(row(page, "r3").locator("td").last).to_contain_text("fell", timeout=PATIENCE_MS)


@pytest.mark.parametrize("page", [("--control",)], indirect=True)
def test_stop_stops_and_is_confirmed_by_the_robots(page: Any) -> None:
    page.locator("#stop").click(timeout=PATIENCE_MS)
    expect(page.locator("#stop")).to_have_text("STOPPED 6/6", timeout=PATIENCE_MS)
    for robot in ("r0", "r5"):
        expect(row(page, robot)).to_contain_text("fault", timeout=PATIENCE_MS)
    page.locator("#arm").click()
    expect(page.locator("#stop")).to_have_text("STOP", timeout=PATIENCE_MS)


@pytest.mark.parametrize("page", [("--control",)], indirect=True)
def test_apps_are_started_set_and_stopped(page: Any) -> None:
    row(page, "r1").click(timeout=PATIENCE_MS)
    page.get_by_label("app to start").fill("formation", timeout=PATIENCE_MS)
    page.get_by_role("button", name="start on all", exact=True).click()
    expect(page.locator("#said")).to_contain_text("formation: started on r0 r1", timeout=PATIENCE_MS)
    until(page, "swarmView.store.names.every((name) => swarmView.store.services[name]['app/formation'])")
    gain = page.get_by_label("formation gain")
    gain.fill("0.7", timeout=PATIENCE_MS)
    gain.press("Enter")
    value = "swarmView.store.get(name, 'app/formation/parameters')?.parameters.gain.value === 0.7"
    until(page, f"swarmView.store.names.every((name) => {value})")
    gain.fill("77")
    gain.press("Enter")
    expect(page.locator("#said")).to_contain_text("gain", timeout=PATIENCE_MS)
    expect(page.locator("#said")).to_have_class("bad", timeout=PATIENCE_MS)
    page.get_by_role("button", name="stop formation", exact=True).click()
    expect(event(page, "r1", "formation is gone")).to_be_visible(timeout=PATIENCE_MS)
    assert page.evaluate("swarmView.store.services.r0['app/formation']")
    page.get_by_role("button", name="stop formation on all").click()
    until(page, "swarmView.store.names.every((name) => !swarmView.store.services[name]['app/formation'])")
    page.get_by_label("app to start").fill("nothing")
    page.get_by_label("app to start").press("Enter")
    expect(page.locator("#said")).to_contain_text("no app nothing: expected consensus", timeout=PATIENCE_MS)


def test_two_viewers_see_the_same_and_one_that_slept_is_up_to_date_at_once(page: Any, browser: Any) -> None:
    with visit(browser, page.view) as other:
        for each in (page, other):
            expect(row(each, "r0")).to_contain_text("consensus", timeout=PATIENCE_MS)
        session = other.context.new_cdp_session(other)
        session.send("Page.setWebLifecycleState", {"state": "frozen"})
        k = page.evaluate("swarmView.store.get('r0', 'app/consensus/state').k")
        until(page, f"swarmView.store.get('r0', 'app/consensus/state').k > {k + 30}")
        session.send("Page.setWebLifecycleState", {"state": "active"})
        until(other, f"swarmView.store.get('r0', 'app/consensus/state').k > {k + 30}")
        expect(other.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)


def test_a_lost_server_is_shown_as_lost(browser: Any, simulation: Simulation) -> None:
    with shown(browser, "--run-dir", simulation.run_dir) as page:
        expect(page.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)
        page.view.close()
        # By the page's own clock 1.5 s after the last word; a busy machine may draw that later.
        expect(page.locator("#connection")).to_have_text("server lost", timeout=PATIENCE_MS)


def test_a_picture_without_a_person(simulation: Simulation, tmp_path: Path) -> None:
    picture = tmp_path / "page.png"
    command = [sys.executable, "-m", "laptop.cli", "view", "--run-dir", str(simulation.run_dir)]
    subprocess.run([*command, "--screenshot", str(picture)], check=True, capture_output=True, timeout=240)
    data = picture.read_bytes()
    assert data.startswith(b"\x89PNG")
    assert len(data) > 50_000  # an empty page has 15 kB


def test_of_a_recording_that_was_cut_off_the_rest_is_named(browser: Any, tmp_path: Path) -> None:
    recorded(tmp_path, "consensus", "--robots", "2", "--iterations", "100")
    file = next(tmp_path.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-2000])
    with shown(browser, tmp_path) as page:
        expect(page.locator("#player .bad")).to_contain_text("cut off", timeout=PATIENCE_MS)
        until(page, "swarmView.store.get('r1', 'app/consensus/state')?.k > 5")


def test_a_recording_is_scrubbed_to_an_instant(browser: Any, tmp_path: Path) -> None:
    recorded(tmp_path, "consensus", "--robots", "3", "--iterations", "200")
    with shown(browser, tmp_path) as page:
        seek(page, 3)
        k = page.evaluate("swarmView.store.get('r1', 'app/consensus/state').k")
        assert k == pytest.approx(98, abs=5)  # 30 ms an iteration
        seek(page, 0.9)
        assert page.evaluate("swarmView.store.get('r1', 'app/consensus/state').k") == pytest.approx(28, abs=5)


def test_the_line_of_a_robot_that_was_off_has_a_gap(browser: Any, tmp_path: Path) -> None:
    away = ("--off", "r1@3s,3s", "--absent", "drop", "--drop-after", "1")
    recorded(tmp_path, "consensus", "--robots", "3", "--topology", "full", "--seconds", "9", *away)
    gaps = (
        "swarmView.errors.chart.plot.lines?.slice(0, 3).map(({points}) => points.filter(([, y]) => y === null).length)"
    )
    with shown(browser, tmp_path) as page:
        seek(page, 9)
        until(page, f"JSON.stringify({gaps}) === '[0,1,0]'")
        # The small lines of the apps' values have the gaps of the chart: the others wait for r1 twice.
        lines = "[...document.querySelectorAll('#robots .spark path')].map((each) => each.getAttribute('d'))"
        until(page, f"JSON.stringify({lines}.map((line) => line?.split('M').length - 2)) === '[2,1,2]'")
        assert page.evaluate(gaps.replace("errors", "values")) == [2, 1, 2]


def test_a_truth_value_that_somebody_asks_for_is_drawn_in_steps(browser: Any, tmp_path: Path) -> None:
    recorded(tmp_path, "stand_up", "--robots", "2", "--seconds", "4", "--press", "r0.A@1s")
    with shown(browser, tmp_path) as page:
        seek(page, 3)
        for topic, field, steps in (("balancer/buttons", "a", "true"), ("balancer/state", "tilt", "false")):
            page.evaluate(f"swarmView.values.open('{topic}', ['{field}'])")
            shown_now = "swarmView.values.shown"
            until(page, f"{shown_now}.name === '{topic} {field}' && {shown_now}.stepped === {steps}")


def test_an_app_that_has_failed_is_told_with_its_robot(browser: Any, tmp_path: Path) -> None:
    (tmp_path / "fails.py").write_text(
        "from swarm import SyncApp\n\nclass Fails(SyncApp):\n    x: float\n\n    def step(self, neighbours):\n"
        "        if self.k == 20 and self.robot.name == 'r1':\n            raise ValueError\n"
    )
    words = [sys.executable, "-m", "laptop.cli", "sim", str(tmp_path / "fails.py"), "--virtual"]
    assert subprocess.run([*words, "--record", str(tmp_path / "run")], check=False, capture_output=True).returncode == 1
    with shown(browser, tmp_path / "run") as page:
        expect(page.locator("[data-answer=alive]")).to_contain_text("the app has failed on r1", timeout=PATIENCE_MS)
        expect(page.locator("[data-answer=converging]")).to_contain_text("No, it has ended", timeout=PATIENCE_MS)
