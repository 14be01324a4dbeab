"""What the page looks like, in a real browser: what is drawn where and in which colour, small screens, keys, themes."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import PATIENCE_MS, seek, shown, until
from virtual_run import recorded

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

pytest_plugins = ("view_fixtures",)
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300), pytest.mark.filterwarnings("ignore::ResourceWarning")]

AT = 5.0
"""s into the run, where the page stands still."""

TELL = """(robots) => {
  swarmView.store.take({t: swarmView.store.t, live: true, robots}, performance.now() - 1000);
  swarmView.map.draw(performance.now());
}"""
"""Puts samples into the page, as old as if all had come to rest."""

NEAR = """([x, y, radius]) => {
  const map = swarmView.map, {width, height} = map.canvas, {x: mx, y: my, scale} = map.shown;
  const px = Math.round(width / 2 + (x - mx) * scale), py = Math.round(height / 2 - (y - my) * scale);
  const side = 2 * radius + 1, data = map.context.getImageData(px - radius, py - radius, side, side).data, found = {};
  for (let i = 0; i < data.length; i += 4) {
    const colour = "#" + [0, 1, 2].map((each) => data[i + each].toString(16).padStart(2, "0")).join("");
    found[colour] = (found[colour] ?? 0) + 1;
  }
  return found;
}"""
"""Colours, and how many pixels have each, around a place of the map."""

GOOD, FAIR, WARN, BAD = "#8a92a0", "#bd7810", "#8f5400", "#c0262d"
"""The page's colours of links, in light."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    recorded(folder, "consensus", "--robots", "3", "--topology", "line", "--seconds", "6")
    return folder


@pytest.fixture
def page(browser: Any, run: Path) -> Iterator[Any]:
    with shown(browser, run, color_scheme="light") as page:
        seek(page, AT)
        yield page


def tell(page: Any, **robots: Any) -> None:
    page.evaluate(TELL, robots)


def near(page: Any, x: float, y: float, radius: int = 30) -> dict[str, int]:
    return page.evaluate(NEAR, [x, y, radius])


def inked(page: Any, x: float, y: float) -> int:
    """Pixels there that are not the map's own."""
    return sum(count for colour, count in near(page, x, y).items() if colour != "#fafbfc")


def place(x: float, y: float, **more: Any) -> dict[str, Any]:
    return {"t": AT, "x": x, "y": y, "heading": 0.0, "tilt": 0.0} | more


def apart(page: Any) -> None:
    """Robots 1 m from each other."""
    tell(page, **{f"r{n}": {"sim/truth": place(float(n), 0.0)} for n in range(3)})


def test_a_robot_has_its_place_its_lights_its_ellipse_and_its_fault(page: Any) -> None:
    apart(page)
    colour = page.evaluate("swarmView.store.colour('r2')")
    body = near(page, 2.0, 0.0, 6)[colour]
    assert body > 20
    assert colour not in near(page, 1.0, 0.0)
    lights = {"red": "#ff3b30", "yellow": "#ffcc00", "green": "#34c759"}
    for lit in lights:
        tell(page, r2={"sim/leds": {"t": AT} | {name: name == lit for name in lights}})
        seen = near(page, 2.0, 0.0)
        assert [name for name, shine in lights.items() if seen.get(shine)] == [lit]
    before = inked(page, 2.0, 0.5)
    tell(page, r2={"dwm/pose": place(2.0, 0.0, deviation_x=0.25, deviation_y=0.25, correlation=0.0)})
    assert inked(page, 2.0, 0.5) > before  # two deviations above it
    tell(page, r2={"balancer/state": {"t": AT, "mode": "balancing", "tilt": 0.1}})
    assert BAD not in near(page, 2.0, 0.0)
    tell(page, r2={"balancer/state": {"t": AT, "mode": "fault", "tilt": 0.1}})
    assert near(page, 2.0, 0.0)[BAD] > 20


def test_a_target_that_moves_is_where_it_is_told_to_be(page: Any) -> None:
    apart(page)
    before = inked(page, 1.0, 0.5)
    tell(page, r1={"sim/target": {"t": AT, "x": 1.0, "y": 0.5}})
    assert inked(page, 1.0, 0.5) > before
    tell(page, r1={"sim/target": {"t": AT, "x": 1.5, "y": 0.5}})
    assert inked(page, 1.0, 0.5) == before


def test_links_have_the_colour_of_their_state_and_the_thickness_of_their_traffic(page: Any) -> None:
    apart(page)

    def link(**more: Any) -> dict[str, int]:
        tell(page, r0={"mesh/links": {"t": AT, "links": [{"peer": "r1", "state": "up", "rtt": 0.01} | more]}})
        return near(page, 0.5, 0.0)

    tell(page, r1={"mesh/links": {"t": AT, "links": []}})
    link(sent_rate=0.0)
    thin = inked(page, 0.5, 0.0)
    assert link(sent_rate=1e6)[GOOD] > 20
    assert inked(page, 0.5, 0.0) > thin + 50
    for more, colour in (
        ({"rtt": 0.3, "rtt_min": 0.02}, FAIR),
        ({"queue": 100_000}, FAIR),
        ({"state": "suspect"}, WARN),
        ({"state": "down"}, BAD),
    ):
        seen = link(sent_rate=1e6, **more)
        assert seen.get(colour, 0) > 5, more
        assert GOOD not in seen, more


def test_a_robot_has_its_trail_and_its_estimate_of_the_target(page: Any) -> None:
    apart(page)
    colour = page.evaluate("swarmView.store.colour('r1')")
    before = inked(page, 1.0, 0.6)
    for y in (0.0, 0.3, 0.6, 0.9, 0.0):
        tell(page, r1={"sim/truth": place(1.0, y)})
    assert inked(page, 1.0, 0.6) > before + 20  # it has passed there, and is away

    assert colour not in near(page, 0.5, 0.5)
    state = {"t": AT, "k": 1, "state": {}, "result": {"x": 0.5, "y": 0.5, "sigma": 0.03}}
    tell(page, r1={"app/localization/state": state})
    assert near(page, 0.5, 0.5, 8)[colour] > 10
    ellipse = inked(page, 0.5, 0.5)
    tell(page, r1={"app/localization/state": state | {"result": {"x": 0.5, "y": 0.5}}})
    assert inked(page, 0.5, 0.5) < ellipse - 20  # a cross only: it does not say how sure it is


def test_a_message_is_a_dot_on_its_way_and_many_are_none(page: Any) -> None:
    apart(page)
    # Drawn and looked at in one step: the page's own next frame has the dot at another place, or none.
    flash = f"""(rate) => {{
      const now = performance.now();
      swarmView.store.flashes.set("r0>r1", {{count: 1, at: now - 80, rate, seen: now}});
      swarmView.map.draw(now);
      return ({NEAR})([0.5, 0.0, 30]);
    }}"""
    assert page.evaluate(flash, 1.0)["#3c4350"] > 10
    assert "#3c4350" not in page.evaluate(flash, 99.0)
    page.emulate_media(color_scheme="light", reduced_motion="reduce")
    assert "#3c4350" not in page.evaluate(flash, 1.0), "somebody wants no motion"


def test_what_is_no_number_harms_nothing(page: Any) -> None:
    apart(page)
    links = {"t": "nan", "links": [{"peer": "r1", "state": "nan", "rtt": "inf"}, None, 7]}
    for wrong in ("nan", None, [], {}, "inf"):
        state = {"t": wrong, "mode": wrong, "tilt": wrong, "battery": wrong, "battery_left": wrong}
        for x in (0.0, wrong):
            pose = place(0.0, 0.0, deviation_x=wrong, deviation_y=wrong, heading=wrong, tilt=wrong) | {"x": x}
            tell(page, r1={"dwm/pose": pose, "sim/truth": pose, "balancer/state": state, "mesh/links": links})
            page.evaluate("swarmView.show()")
    # It is no change without end. Drawn twice in one step: the page's own frames come between two.
    drawn = "[0, 0].map(() => (swarmView.map.draw(performance.now()), swarmView.map.drawn))"
    assert len(set(page.evaluate(drawn))) == 1
    expect(page.locator("tr[data-robot=r1]")).to_be_visible()
    assert near(page, 2.0, 0.0, 6)[page.evaluate("swarmView.store.colour('r2')")] > 20


def test_a_battery_that_is_not_read_any_more_has_no_voltage(page: Any) -> None:
    row = page.locator("tr[data-robot=r1]")
    for volts, level in ((7.31, "ok"), (None, "unknown")):
        state = {"t": 1.0, "mode": "idle", "tilt": 0.0, "battery": volts, "battery_level": level}
        tell(page, r1={"balancer/battery": {"t": 1.0, "voltage": 7.31}, "balancer/state": state})
        page.evaluate("swarmView.show()")
        shows = expect(row)
        (shows.to_contain_text if volts else shows.not_to_contain_text)("7.31 V", timeout=PATIENCE_MS)


def test_metres_are_the_unit_of_a_place_and_of_no_other_x(page: Any) -> None:
    for told, units in (({"x": 3.0}, {"x": ""}), ({"x": 3.0, "y": 4.0}, {"x": "m", "y": "m"})):
        for part in ("state", "result"):
            state = {"t": AT, "k": 1, "state": {}, "result": {}} | {part: told}
            tell(page, **{f"r{n}": {"app/consensus/state": state} for n in range(3)})
            found = page.evaluate("swarmView.focus.values().map(({ label, unit }) => [label, unit])")
            assert {label: unit for label, unit in found if label in told} == units


def test_all_can_be_reached_by_keys(page: Any) -> None:
    page.locator("#time").focus()
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.dataset.robot") == "r1":
            break
    page.keyboard.press("Enter")
    expect(page.locator("#keys h2")).to_have_text("swarm/r1")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    number = page.locator("#keys button", has_text=re.compile(r"^state\.value="))
    number.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#values select")).to_have_value("app/consensus/state state.value", timeout=PATIENCE_MS)
    over = page.locator("#values [data-over=k]")
    over.focus(timeout=PATIENCE_MS)
    page.keyboard.press("Enter")
    expect(over).to_have_attribute("aria-pressed", "true", timeout=PATIENCE_MS)
    page.locator("#map canvas").focus()
    before = page.evaluate("swarmView.map.shown")
    page.keyboard.press("+")
    page.keyboard.press("ArrowLeft")
    until(page, f"swarmView.map.shown.scale > {before['scale']} && swarmView.map.shown.x < {before['x']}")
    page.keyboard.press("0")
    until(page, f"swarmView.map.shown.scale === {before['scale']}")


def test_a_chart_of_a_field_that_does_not_exist_is_named(browser: Any, run: Path) -> None:
    with shown(browser, run) as page:
        seek(page, AT)
        page.evaluate("swarmView.values.open('app/consensus/state', ['state', 'nothing'])")
        said = page.locator("#values .empty")
        expect(said).to_contain_text("app/consensus/state state.nothing: no robot has told", timeout=PATIENCE_MS)


def test_names_of_fields_are_those_of_the_message(page: Any) -> None:
    tell(page, r0={"balancer/display": {"t": AT, "lines": ["r0", "value 2.5"]}})
    page.locator("tr[data-robot=r0]").click()
    expect(page.locator("#keys dd", has_text='lines.1="value 2.5"')).to_be_visible(timeout=PATIENCE_MS)


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1024, 768)])
def test_the_page_fits_on_a_phone_and_its_stop_button_stays_in_sight(
    browser: Any, run: Path, width: int, height: int
) -> None:
    with shown(browser, run, viewport={"width": width, "height": height}) as page:
        seek(page, AT)
        page.locator("tr[data-robot=r0] th").click()
        page.evaluate("swarmView.store.swarm.acts = ['stop', 'set', 'start']")
        stop = page.locator("#stop")
        expect(stop).to_be_visible(timeout=PATIENCE_MS)
        page.evaluate("scrollTo(0, document.body.scrollHeight)")
        expect(stop).to_be_in_viewport(ratio=1.0)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_a_button_switches_the_page_between_light_and_dark(page: Any) -> None:
    colours = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(colours)
    page.locator("#theme").click()
    assert page.evaluate(colours) != light
    until(page, "swarmView.map.context.getImageData(1, 1, 1, 1).data[0] < 60")  # the map too
    page.locator("#theme").click()
    assert page.evaluate(colours) == light
