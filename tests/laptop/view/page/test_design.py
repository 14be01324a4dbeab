"""The design's acceptance checks, in a real browser: what is in sight without a click, and on which screens."""

import itertools
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import PATIENCE_MS, row, seek, shown, until
from virtual_run import recorded

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

pytest_plugins = ("view_fixtures",)
pytestmark = [pytest.mark.timeout(300), pytest.mark.filterwarnings("ignore::ResourceWarning")]

DESK = {"width": 1440, "height": 900}
LONGEST = "robot-number-000"
"""A robot's name of as many characters as it may have."""
SIX = ("map", "values", "pace", "error", "robots", "events")
ACTS = (
    "swarmView.store.swarm.acts = ['stop', 'arm', 'mode', 'set', 'start', 'end', 'cut', 'kill', 'press', 'push', 'lay']"
)

INSIDE = """(selector) => [...document.querySelectorAll(selector)].every((each) => {
  const {left, top, right, bottom} = each.getBoundingClientRect();
  return left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight && right > left && bottom > top;
})"""

ON_TOP = """(() => {
  const {left, right, top, width, height} = document.querySelector("#stop").getBoundingClientRect();
  const found = document.elementFromPoint(left + width / 2, top + height / 2)?.id;
  return found === "stop" && width >= 44 && height >= 34 && left >= 0 && right <= innerWidth;
})()"""

CUT = """(() => [...document.querySelectorAll(
  "#answers b, #answers small, .hero b, #robots td.num, #clock output")].filter((each) => each.offsetParent
  && each.scrollWidth > each.clientWidth + 1 && !/^(event)$/.test(each.closest("[data-answer]")?.dataset.answer ?? ""))
  .map((each) => each.textContent))()"""
"""Figures that do not fit where they stand."""

SMALL = """[...document.querySelectorAll("button, select, input")].filter((each) => each.offsetParent
  && !each.closest("dd") && each.getBoundingClientRect().height < 44).map((each) => each.id || each.textContent)"""
"""What a finger would miss, but for numbers in a text."""

LAID_OUT = """(() => {
  const boxes = [...document.querySelectorAll("main > .panel")].filter((each) => !each.hidden)
    .map((each) => each.getBoundingClientRect());
  const before = (a, b) => a.right <= b.left + 1 || a.bottom <= b.top + 1;
  const apart = (a, b) => before(a, b) || before(b, a);
  return boxes.length === 6 && boxes.every((a) => a.height > 100 && boxes.every((b) => a === b || apart(a, b)));
})()"""
"""Whether each of the panels has its own place."""

LINKS_IN_RIMS = """(() => {
  const map = swarmView.map, {width, height} = map.canvas, {x: mx, y: my, scale} = map.shown;
  const [r, g, b] = [0xc0, 0x26, 0x2d], radius = Math.floor(1.7 * Math.max(8 * map.ratio, 0.055 * scale));
  const side = 2 * radius;
  let found = 0;
  for (const {x, y} of map.placed.values()) {
    const px = Math.round(width / 2 + (x - mx) * scale), py = Math.round(height / 2 - (y - my) * scale);
    const data = map.context.getImageData(px - radius, py - radius, side, side).data;
    for (let i = 0; i < data.length; i += 4) {
      const at = i / 4, inside = Math.hypot((at % side) - radius, Math.floor(at / side) - radius) < radius;
      if (inside && Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 30) found += 1;
    }
  }
  return found;
})()"""

LATER = """for (const entry of swarmView.series.entries.values()) {
  for (const {rows} of entry.sources) for (const points of rows.values()) for (const point of points) point[0] += 100;
  swarmView.series.touch(entry);
}"""
"""All that robots tell is told 100 s later."""


@pytest.fixture(scope="module")
def waits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six robots in lockstep, of which two lose each other at 2 s."""
    folder = tmp_path_factory.mktemp("runs") / "waits"
    recorded(folder, "consensus", "--robots", "6", "--topology", "line", "--seconds", "9", "--cut", "r2-r3@2s,60s")
    return folder


@pytest.fixture(scope="module")
def forms(waits: Path) -> Path:
    """Three robots of a periodic app, in the same folder of runs."""
    folder = waits.parent / "forms"
    recorded(folder, "formation", "--robots", "3", "--seconds", "8")
    return folder


@pytest.fixture
def waiting(browser: Any, waits: Path) -> Iterator[Any]:
    with shown(browser, waits, viewport=DESK, color_scheme="light") as page:
        seek(page, 8)
        yield page


def test_five_answers_and_six_panels_are_in_sight_and_a_cut_link_is_named(waiting: Any) -> None:
    held = waiting.locator("[data-answer=held] b")
    expect(held).to_contain_text("Link r2–r3 down", timeout=PATIENCE_MS)
    expect(waiting.locator("[data-answer=held] small")).to_contain_text("all 6 wait")
    lasts = float(re.search(r"down, ([\d.]+) s", held.text_content())[1])
    assert lasts > 3, "since nothing was heard on it, not since the last word about it"
    expect(waiting.locator("[data-answer=converging] b")).to_have_text("Held")
    for selector in ("#answers button", "#bar", "footer", *(f"#{each}" for each in SIX)):
        assert waiting.evaluate(INSIDE, selector), selector
    assert waiting.evaluate("document.documentElement.scrollHeight <= innerHeight")
    expect(waiting.locator("#values .plot canvas")).to_be_visible(timeout=PATIENCE_MS)
    assert waiting.evaluate(INSIDE, "#robots tbody tr")


@pytest.mark.slow
def test_a_periodic_app_has_its_values_and_steps_and_no_columns_of_iterations(browser: Any, forms: Path) -> None:
    with shown(browser, forms, viewport=DESK) as page:
        seek(page, 7)
        expect(page.locator("#values .plot canvas")).to_be_visible(timeout=PATIENCE_MS)
        expect(page.locator("#values select")).to_have_value("app/formation/record/off value", timeout=PATIENCE_MS)
        expect(page.locator("#lockstep")).to_be_hidden()
        expect(page.locator("#lanes h2")).to_have_text("Steps")
        assert page.evaluate("swarmView.lanes.rate()") == pytest.approx(10.0, rel=0.1)
        assert page.evaluate("swarmView.lanes.left") == 44
        page.evaluate(f"swarmView.store.swarm.robots[2] = '{LONGEST}'; swarmView.lanes.shape = ''")
        until(page, "swarmView.lanes.left > 100")  # no step is drawn below a name


@pytest.mark.slow
def test_an_event_app_has_a_lane_a_robot_with_a_mark_for_each_kind_of_event(browser: Any, tmp_path: Path) -> None:
    recorded(tmp_path / "leds", "led_sync", "--robots", "3", "--seconds", "5")
    with shown(browser, tmp_path / "leds", viewport=DESK) as page:
        seek(page, 4)
        expect(page.locator("#lanes h2")).to_have_text("Handled", timeout=PATIENCE_MS)
        expect(page.locator("#lanes .unit")).to_have_text("dots: changes, bars: on, the last 60 s", timeout=PATIENCE_MS)
        expect(page.locator("[data-answer=converging] b")).to_contain_text("All at", timeout=PATIENCE_MS)
        expect(page.locator("#values [data-over=k]")).to_be_hidden()


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(320, 640), (390, 844), (800, 700), (1024, 768), (1920, 1080)])
def test_nothing_is_cut_and_stop_is_on_top_on_any_screen(browser: Any, waits: Path, width: int, height: int) -> None:
    with shown(browser, waits, viewport={"width": width, "height": height}) as page:
        seek(page, 8)
        page.locator("#values").scroll_into_view_if_needed(timeout=PATIENCE_MS)
        expect(page.locator("#values .plot canvas")).to_be_visible(timeout=PATIENCE_MS)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert page.evaluate(CUT) == []
        assert page.evaluate(LAID_OUT)
        page.evaluate(ACTS)
        expect(page.locator("#stop")).to_be_visible(timeout=PATIENCE_MS)
        page.evaluate(f"swarmView.store.swarm.robots[0] = '{LONGEST}'")
        page.evaluate("for (const name of swarmView.store.names) swarmView.store.stops.set(name, true)")
        for act in (
            "scrollTo(0, 0)",
            "scrollTo(0, document.body.scrollHeight)",
            f"swarmView.select('{LONGEST}')",
            "document.querySelector('#find').click()",
            "swarmView.layout.arrange()",
        ):
            page.evaluate(act)
            until(page, ON_TOP)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_a_robot_with_the_longest_name_leaves_room_for_stop_and_its_outcome_and_has_its_value_in_charts(
    browser: Any, waits: Path
) -> None:
    with shown(browser, waits, viewport={"width": 1440, "height": 900}) as page:
        seek(page, 8)
        expect(page.locator("#values .plot canvas")).to_be_visible(timeout=PATIENCE_MS)
        page.evaluate(ACTS)
        page.evaluate("swarmView.store.stops.set('r1', true)")
        page.evaluate(f"swarmView.store.swarm.robots.push('{LONGEST}'); swarmView.select('{LONGEST}')")
        page.evaluate("document.querySelector('#said').textContent = 'stop given to all robots'")
        expect(page.get_by_role("button", name=f"stand {LONGEST}")).to_be_visible(timeout=PATIENCE_MS)
        assert page.evaluate(
            "(({scrollWidth, clientWidth}) => scrollWidth <= clientWidth)(document.querySelector('#said'))"
        )
        for width in (1440, 1200, 1024, 800):
            page.set_viewport_size({"width": width, "height": 800})
            until(page, ON_TOP)
        assert page.evaluate("swarmView.values.chart.plot.right") == 84, "of short names"
        points = "[[0, 1, 0], [8, 2, 0]]"
        page.evaluate(
            "swarmView.values.chart.plot.draw({scale: {unit: '', factor: 1}, lines: "
            f"[{{name: '{LONGEST}', colour: '#000000', points: {points}}}]}})"
        )
        assert page.evaluate("swarmView.values.chart.plot.right") > 150


@pytest.mark.slow
def test_names_of_robots_20_cm_apart_do_not_meet_and_links_end_at_rims(waiting: Any) -> None:
    robots = {
        f"r{n}": {"sim/truth": {"t": 8.0, "x": 0.2 * (n % 3), "y": 0.2 * (n // 3), "heading": 0.0, "tilt": 0.0}}
        for n in range(6)
    }
    links = {"mesh/links": {"t": 8.0, "links": [{"peer": f"r{n}", "state": "down"} for n in range(6)]}}
    for robot in robots.values():
        robot.update(links)
    waiting.evaluate(
        "([robots, edges]) => {const was = swarmView.store.swarm; swarmView.store.clear();"
        " swarmView.store.become({...was, robots: Object.keys(robots), kind: 'simulation', edges});"
        " swarmView.store.take({t: 8, live: true, robots}, performance.now() - 1000); swarmView.map.box = null}",
        [robots, list(itertools.combinations(robots, 2))],
    )
    waiting.evaluate("swarmView.map.draw(performance.now())")
    boxes = waiting.evaluate("[...swarmView.map.boxes].filter(([name]) => name.length === 2).map(([, box]) => box)")
    assert len(boxes) == 6
    for a, b in itertools.combinations(boxes, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
    assert waiting.evaluate(LINKS_IN_RIMS) == 0


@pytest.mark.slow
def test_a_name_that_would_cover_another_one_moves_at_once(waiting: Any) -> None:
    overlaps = waiting.evaluate("""async () => {
      const { Labels } = await import("/page/map/labels.js"), labels = new Labels();
      const item = (name, x, y) => ({ name, x, y, r: 10, width: 60, height: 13 });
      return [140, 130, 120, 110].map((y, look) => {
        const [a, b] = labels.place([item("a", 100, 100), item("b", 130, y)], [], 800, 400, 1e3 + 250 * look).values();
        return a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
      });
    }""")
    assert overlaps == [False] * 4


def test_before_its_first_value_nothing_is_said_of_what_an_app_computes(waiting: Any) -> None:
    expect(waiting.locator("#values .hero b")).to_have_text(re.compile(r"\d"), timeout=PATIENCE_MS)
    waiting.evaluate(LATER)
    expect(waiting.locator("[data-answer=converging] b")).to_have_text("No values yet", timeout=PATIENCE_MS)
    expect(waiting.locator("#values .hero b")).to_have_text("-", timeout=PATIENCE_MS)
    expect(waiting.locator("#values .hero .note")).to_contain_text("nothing told yet")


def test_of_a_robot_that_is_gone_the_table_says_so_in_place_of_its_last_mode(waiting: Any) -> None:
    expect(row(waiting, "r1")).to_contain_text("balancing", timeout=PATIENCE_MS)
    waiting.evaluate("swarmView.store.gone = (name) => name === 'r1'")
    expect(row(waiting, "r1").locator("td.body.app").first).to_have_text("gone", timeout=PATIENCE_MS)
    expect(row(waiting, "r1")).to_have_attribute("data-kind", "bad")
    expect(row(waiting, "r2")).to_contain_text("balancing")


def test_a_robot_that_is_gone_holds_others_up_and_is_none_of_those_that_wait(waiting: Any) -> None:
    held = waiting.locator("[data-answer=held]")
    expect(held.locator("small")).to_contain_text("all 6 wait", timeout=PATIENCE_MS)
    waiting.evaluate("swarmView.store.gone = (name) => name === 'r3'")
    expect(held.locator("b")).to_have_text("r3 (gone)", timeout=PATIENCE_MS)
    expect(held.locator("small")).to_have_text("all 5 wait")


def test_robots_of_a_swarm_that_is_spread_far_are_whole_at_the_edges_of_the_map(waiting: Any) -> None:
    places = "new Map([['r0', {x: 0, y: 0}], ['r1', {x: 200, y: 200}]])"
    left, bottom = waiting.evaluate(
        f"(({{x, y, scale}}) => [200 - x * scale, 200 - y * scale])(swarmView.map.fit({places}, [], 400, 400))"
    )
    assert min(left, bottom) > 15, "pixels from the map's edge to a robot's middle"


@pytest.mark.slow
def test_what_several_robots_tell_at_once_is_one_line_of_events(waiting: Any) -> None:
    told = [
        *((0.1, f"r{n}", "info", f"link to r{n + by} up") for n in range(1, 4) for by in (-1, 1)),
        *((0.3 + 0.1 * n, f"r{n}", "info", "app/consensus running") for n in range(6)),
        *((5.0, robot, "warning", f"link to {peer} suspect") for robot, peer in (("r3", "r2"), ("r2", "r3"))),
        (7.0, "r2", "warning", "link to r3 down: silent for 3 s"),
        (8.0, "r1", "warning", "app/consensus waiting for r2"),
        (8.2, "r4", "warning", "app/consensus waiting for r3"),
        (9.5, "r5", "warning", "app/consensus waiting for r4"),
    ]
    lines = waiting.evaluate(
        """async (told) => {
          const { Events } = await import("/page/panels/events.js");
          const panel = document.querySelector("#events").cloneNode(true), events = new Events(panel, swarmView.store);
          events.draw(told.map(([t, robot, level, text], at) => ({ number: at + 1, t, robot, level, text })));
          return [...panel.querySelectorAll("li")].map((line) => line.lastChild.textContent);
        }""",
        told,
    )
    assert lines == [
        "r5 consensus waiting for r4",
        "r1 r4 consensus waiting for r2 r3",
        "r2–r3 link down: silent for 3 s",
        "r2–r3 link suspect",
        "all consensus running",
        "4 links up",
    ]


@pytest.mark.slow
def test_a_value_that_sways_at_a_few_hundredths_of_what_it_was_has_settled(waiting: Any) -> None:
    said = waiting.evaluate("""async () => {
      const { Answers } = await import("/page/panels/answers.js");
      const sways = (i) => (i < 200 ? 1.5 * Math.exp(-i / 40) : 0.01 + 0.0002 * (i - 200));
      const rows = (y) => Array.from({ length: 300 }, (_, i) => [i / 10, y(i)]);
      const said = (y) => Object.assign(Object.create(Answers.prototype), {
        values: { first: { label: "off", unit: "m" } }, focus: { kind: "periodic" },
        store: { swarm: { recording: {} }, t: 29.9, names: ["r0"] },
        series: { want: () => ({}), robots: () => ["r0"], points: () => rows(y) }
      }).converging().value;
      return [said(sways), said((i) => 0.1 + 0.005 * i)];
    }""")
    assert said == ["Yes, settled", "No, it grows"]


@pytest.mark.slow
def test_a_run_beside_is_at_the_same_instant_and_its_differences_are_told(
    browser: Any, waits: Path, forms: Path
) -> None:
    with shown(browser, forms, viewport=DESK) as page:
        seek(page, 4)
        page.keyboard.press("r")
        page.get_by_role("button", name="put waits beside").click(timeout=PATIENCE_MS)
        for measure in ("length, s", "Position error, median at the end, cm"):
            expect(page.locator("#difference tbody")).to_contain_text(measure, timeout=PATIENCE_MS)
        seek(page, 5)
        until(page, "Object.keys(swarmView.store.besidePlaces ?? {}).length === 6")
        page.get_by_role("button", name="show waits").click()
        until(page, "swarmView.store.swarm.recording.name === 'waits'")
        expect(page.locator("#lockstep")).to_be_visible(timeout=PATIENCE_MS)


@pytest.mark.slow
def test_both_of_two_runs_are_distances_from_their_means_on_a_logarithmic_axis(browser: Any, waits: Path) -> None:
    shutil.copytree(waits, waits.parent / "twin")
    lines = "swarmView.values.chart.plot.plot?.data"
    with shown(browser, waits, viewport=DESK) as page:
        seek(page, 4)
        page.keyboard.press("r")
        page.get_by_role("button", name="put twin beside").click(timeout=PATIENCE_MS)
        page.locator("#values [data-log=log]").click()
        until(page, f"{lines}.length === 13 && {lines}[1][0] < 3")  # from the mean, which is 2.6, not from zero
        assert page.evaluate(f"JSON.stringify({lines}.slice(1, 7)) === JSON.stringify({lines}.slice(7))")
        settled = page.locator("#difference tr", has_text="stays below 5 % of its most after, s").locator("td")
        expect(settled.last).to_have_text("0", timeout=PATIENCE_MS)
        assert 0.3 < float(settled.nth(1).text_content()) < 5


@pytest.mark.slow
def test_a_layout_outlives_a_reload(waiting: Any) -> None:
    waiting.keyboard.press("l")
    waiting.get_by_label("show pace").uncheck(timeout=PATIENCE_MS)
    waiting.get_by_label("name of the layout").fill("mine")
    waiting.get_by_role("button", name="keep").click()
    expect(waiting.locator("#layout")).to_have_value("mine", timeout=PATIENCE_MS)
    waiting.reload()
    expect(waiting.locator("#layout")).to_have_value("mine", timeout=PATIENCE_MS)
    expect(waiting.locator("#pace")).to_be_hidden()
    expect(waiting.locator("#map")).to_be_visible()


@pytest.mark.slow
def test_a_click_on_the_map_sets_a_goal_and_a_held_arrow_drives_until_it_is_let_go(waiting: Any) -> None:
    waiting.evaluate(ACTS.replace("'lay'", "'drive'"))
    waiting.evaluate(
        "const send = WebSocket.prototype.send; globalThis.sent = [];"
        "WebSocket.prototype.send = function (text) { const { do: act } = JSON.parse(text);"
        " if (act) sent.push(act); else send.call(this, text); }; 0"
    )
    waiting.locator("#robots tr[data-robot=r1]").click(timeout=PATIENCE_MS)
    box = waiting.locator("#map canvas").bounding_box()
    waiting.mouse.click(box["x"] + 40, box["y"] + box["height"] - 60)
    send = waiting.locator("#send-goal")
    expect(send).to_contain_text("Send r1 to", timeout=PATIENCE_MS)
    send.click()
    (start,) = waiting.evaluate("sent")
    goal = waiting.evaluate("`${swarmView.map.wanted.x.toFixed(3)},${swarmView.map.wanted.y.toFixed(3)}`")
    settings = {"waypoints": "stay", "r1.waypoints": f"{goal} stay"}
    assert start == {"act": "start", "app": "goto", "settings": settings}
    waiting.evaluate("sent.length = 0")
    waiting.get_by_role("button", name="drive r1 forward while held").hover()
    waiting.mouse.down()
    until(waiting, "sent.length >= 2")
    waiting.mouse.up()
    until(waiting, "sent.at(-1).speed === 0")
    assert waiting.evaluate("sent[0]") == {"act": "drive", "robot": "r1", "speed": 0.15, "turn": 0}
    before = waiting.evaluate("sent.length")
    waiting.wait_for_timeout(400)
    assert waiting.evaluate("sent.length") == before


@pytest.mark.slow
def test_a_bracket_of_the_strip_zooms_the_charts_by_hand_and_by_keys(waiting: Any) -> None:
    first, last = waiting.evaluate("swarmView.bracket.range")
    begin = waiting.get_by_role("slider", name="charts show from, s")
    box, track = begin.bounding_box(timeout=PATIENCE_MS), waiting.locator("#track").bounding_box()
    waiting.mouse.move(box["x"] + 12, box["y"] + 12)
    waiting.mouse.down()
    waiting.mouse.move(track["x"] + track["width"] / 2, box["y"] + 12)
    waiting.mouse.up()
    half = waiting.evaluate("swarmView.bracket.range[0]")
    assert half == pytest.approx((first + last) / 2, abs=0.02 * (last - first))
    least = "swarmView.values.chart.plot.plot?.scales.x.min"
    until(waiting, f"Math.abs({least} - swarmView.bracket.range[0]) < 1e-6")
    end = waiting.get_by_role("slider", name="charts show up to, s")
    end.press("ArrowLeft")
    assert waiting.evaluate("swarmView.bracket.range") == pytest.approx([half, last - 0.01 * (last - first)])
    assert waiting.evaluate("swarmView.store.t") == 8
    waiting.locator("#values [data-over=k]").click()
    until(waiting, f"({least}) > 40")  # iterations of the second half
    waiting.locator("#values [data-over=t]").click()
    begin.dblclick()
    assert waiting.evaluate("swarmView.bracket.range") == [first, last]


@pytest.mark.slow
def test_points_are_marked_only_while_they_are_few(waiting: Any) -> None:
    expect(waiting.locator("#values .plot canvas")).to_be_visible(timeout=PATIENCE_MS)
    marked = waiting.evaluate("""async () => {
      const { Plot } = await import("/page/charts/plot.js"), plot = new Plot(document.querySelector("#values .plot"));
      return [2, 50].map((count) => {
        const points = Array.from({ length: count }, (_, at) => [at, at * at]);
        plot.draw({ lines: [{ name: "r0", colour: "#2743b8", points }], scale: { unit: "", factor: 1 } });
        return plot.plot.series[1].points.show(plot.plot, 1, 0, count - 1);
      });
    }""")
    assert marked == [True, False]


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, 390])
def test_a_phone_has_brackets_film_and_picture(browser: Any, waits: Path, width: int) -> None:
    with shown(browser, waits, viewport={"width": width, "height": 740}, has_touch=True, is_mobile=True) as page:
        seek(page, 8)
        for name in ("charts show from, s", "charts show up to, s"):
            expect(page.get_by_role("slider", name=name)).to_be_visible(timeout=PATIENCE_MS)
        for selector in ("#track .edge", "#keep button", "#speed select", "#play"):
            assert page.evaluate(INSIDE, selector), selector
        expect(page.get_by_role("button", name="Film")).to_be_visible()
        page.evaluate(ACTS)
        expect(page.locator("#parameters input, #apps input").first).to_be_visible(timeout=PATIENCE_MS)
        assert page.evaluate(SMALL) == []
        first, last = page.evaluate("swarmView.bracket.range")
        page.get_by_role("slider", name="charts show from, s").press("ArrowRight")
        assert page.evaluate("swarmView.bracket.range[0]") == pytest.approx(first + 0.01 * (last - first))


@pytest.mark.slow
def test_a_picture_of_what_is_shown_is_made_by_the_server(waiting: Any) -> None:
    with waiting.expect_download(timeout=2 * PATIENCE_MS) as download:
        waiting.get_by_role("button", name="Picture").click()
    assert download.value.suggested_filename == "waits.png"
    assert download.value.path().read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_of_many_robots_there_are_cells_in_sight_and_trouble_is_marked(browser: Any, tmp_path: Path) -> None:
    recorded(tmp_path / "many", "consensus", "--robots", "40", "--seconds", "6", "--cut", "r2-r3@1s,60s")
    with shown(browser, tmp_path / "many", viewport=DESK) as page:
        seek(page, 5.5)
        expect(page.locator("#robots tr[data-robot=r3]")).to_have_attribute("data-kind", "bad", timeout=PATIENCE_MS)
        assert page.evaluate(INSIDE, "#robots tbody tr")
        expect(page.locator("#robots tr[data-robot=r39] td.b")).not_to_have_text("-")
        page.get_by_role("button", name="Network").click()
        expect(page.locator("#robots thead")).to_be_visible()
