"""Apps that blink, stand and drive together, as the simulated world sees them: from LEDs' registers and true poses.

LEDs, stand-up and one formation with the balancing bodies, in real time; formations from many starts and the crossings
in virtual time, with the cart that follows the balancer's ramps.
"""

import math
import random
import statistics
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from bench.rigs.simulation import simulate
from bench.rows import Row, measured
from sim.core.contacts import TOUCH_M
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun

LINKS = ("--robots", "6", "--topology", "line", "--latency", "30ms", "--jitter", "10ms")
NEIGHBOURS_MS, ALL_MS, TOGETHER_S = 10.0, 20.0, 30.0
"""Goals: 95 % of the differences between LEDs, and from the command until they blink together."""
FREQUENCIES = {"r0": 1.8, "r1": 2.0, "r2": 2.1, "r3": 2.2, "r4": 2.3, "r5": 2.2}
"""Hz, at first."""
THESIS_TOGETHER_S = 40.0
"""Figure 4.6: 40 s and 160 s."""

PERIOD_S = 6.0
"""Of stand_up, as in the thesis."""
MISFIT_M, FORMED_S = 0.05, 60.0
CROSSING_S = 60.0
RADIUS, SPREAD, CENTRE = 0.8, 0.08, 0.97


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    seconds: float = 60.0
    """Of each run but that of stand_up."""

    stand_up_s: float = 25.0
    led_seeds: int = 10
    starts: int = 10
    """Formations in virtual time."""

    crossings: int = 100

    @property
    def run(self) -> tuple[str, str]:
        """The option that ends a run after `seconds`."""
        return "--seconds", f"{self.seconds:g}"

    @property
    def steps(self) -> tuple[str, str]:
        """The option that ends a run of an app that steps at 10 Hz after `seconds`."""
        return "--iterations", f"{10 * self.seconds:.0f}"


FULL = Sizes()
SMOKE = Sizes(3.0, 3.0, 1, 1, 1)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    yield from _leds(sizes)
    yield from _leds_of_own_clocks(sizes)
    yield from _stand_up(sizes)
    yield from _formation(sizes)
    yield from _crossings(sizes)


def _leds(sizes: Sizes) -> Iterator[Row]:
    settings = [word for robot, value in FREQUENCIES.items() for word in ("--set", f"{robot}.frequency_value={value}")]
    for algorithm, judged in (("clock", 1.0), ("thesis", None)):
        scene = _real("led_sync", *LINKS, "--algorithm", algorithm, *sizes.run, *settings)
        name = f"LEDs, {algorithm}"
        after = _figure(scene, "synchronous_after_s")
        yield Row(
            f"{name}: neighbours apart, 95 %", _figure(scene, "apart_neighbours_p95_ms"), "ms", NEIGHBOURS_MS, judged
        )
        yield Row(f"{name}: any two apart, 95 %", _figure(scene, "apart_all_p95_ms"), "ms", ALL_MS, judged)
        limit = TOGETHER_S if judged else THESIS_TOGETHER_S
        yield Row(f"{name}: together within 20 ms after", after, "s", limit, judged)


def _leds_of_own_clocks(sizes: Sizes) -> Iterator[Row]:
    """In virtual time, which has what processes of one machine have not: clocks with other zeros and rates."""
    settings = {f"{robot}.frequency_value": str(value) for robot, value in FREQUENCIES.items()}
    skew = ("--clock-skew", "30ppm", *sizes.run)
    found = [_virtual("led_sync", {}, settings, *skew, "--seed", str(seed)) for seed in range(sizes.led_seeds)]
    name = f"LEDs, clocks of +- 30 ppm, worst of {sizes.led_seeds}"
    yield Row(f"{name}: neighbours apart, 95 %", _worst(found, "apart_neighbours_p95_ms"), "ms", NEIGHBOURS_MS, 1.0)
    yield Row(f"{name}: any two apart, 95 %", _worst(found, "apart_all_p95_ms"), "ms", ALL_MS, 1.0)
    yield Row(f"{name}: together within 20 ms after", _worst(found, "synchronous_after_s"), "s", TOGETHER_S, 1.0)


def _stand_up(sizes: Sizes) -> Iterator[Row]:
    """Five lying robots in line, the button of r4."""
    arguments = ("--robots", "5", "--topology", "line", "--press", "r4.A@1s", "--seconds", f"{sizes.stand_up_s:g}")
    scene = _real("stand_up", *arguments)
    after = scene.get("after_its_neighbour_s")
    gaps = [math.nan if gap is None else float(gap) for gap in after.values()] if isinstance(after, dict) else []
    slowest = max(measured(gaps)) if len(gaps) == 4 else math.nan
    yield Row("stand_up: a robot stands after its neighbour", slowest, "s", PERIOD_S, 1.0)


def _formation(sizes: Sizes) -> Iterator[Row]:
    scene = _real("formation", *LINKS, *sizes.run)
    yield Row("formation, balancing bodies: rms at 60 s", _figure(scene, "misfit_m"), "m", MISFIT_M, 1.0)
    yield Row("formation, balancing bodies: formed after", _figure(scene, "formed_after_s"), "s", FORMED_S, 1.0)
    found = []
    for seed in range(sizes.starts):
        generator = random.Random(f"formation {seed}")
        places = _scattered(generator, 6)
        found.append(_virtual("formation", places, {}, *sizes.steps, "--seed", str(seed)))
    yield Row(
        f"formation, {sizes.starts} random starts: worst rms at 60 s", _worst(found, "misfit_m"), "m", MISFIT_M, 1.0
    )
    yield Row("the same: slowest formed after", _worst(found, "formed_after_s"), "s", FORMED_S, 1.0)
    yield Row("the same: contact, beside the nearest two came", TOUCH_M, "m", _closest(found), 1.0)


def _crossings(sizes: Sizes) -> Iterator[Row]:
    """Six robots on a circle, each to about the opposite side."""
    found, arrived, took = [], 0, []
    for seed in range(sizes.crossings):
        places, settings = crossing(seed)
        scene = _virtual("goto", places, settings, *sizes.steps, "--seed", str(seed))
        found.append(scene)
        arrived += bool(scene["all_arrived"])
        took.append(_figure(scene, "seconds"))
    yield Row(f"{sizes.crossings} crossings: contact, beside the nearest two came", TOUCH_M, "m", _closest(found), 1.0)
    yield Row("the same: missed within 60 s", sizes.crossings - arrived, "", 1.0, 0.0)
    yield Row("the same: slowest", max(measured(took)), "s", CROSSING_S, 1.0)
    yield Row("the same: median", statistics.median(measured(took)), "s", 2 * RADIUS / 0.2, None)


def crossing(seed: int, count: int = 6) -> tuple[dict[str, tuple[float, float, float]], dict[str, str]]:
    """Places (m, rad) of the robots by name, and the values that are their waypoints."""
    generator = random.Random(f"crossing {seed}")
    turned = generator.uniform(0.0, math.tau)
    places, waypoints = {}, {}
    for i in range(count):
        start, end = (turned + math.tau * i / count + half + generator.gauss(0.0, SPREAD) for half in (0.0, math.pi))
        places[f"r{i}"] = (*_on_circle(start), generator.uniform(-math.pi, math.pi))
        waypoints[f"r{i}.waypoints"] = "{:.4f},{:.4f}".format(*_on_circle(end))
    return places, waypoints


def _on_circle(angle: float) -> tuple[float, float]:
    return CENTRE + RADIUS * math.cos(angle), CENTRE + RADIUS * math.sin(angle)


def _scattered(generator: random.Random, count: int) -> dict[str, tuple[float, float, float]]:
    """Random places on the table, no two within half a metre."""
    places: list[tuple[float, float]] = []
    while len(places) < count:
        place = (generator.uniform(0.1, 1.85), generator.uniform(0.1, 1.85))
        if all(math.dist(place, other) > 0.5 for other in places):
            places.append(place)
    return {f"r{i}": (*place, generator.uniform(-math.pi, math.pi)) for i, place in enumerate(places)}


def _real(*arguments: str) -> Mapping[str, Any]:
    """What the world saw of a run in real time; nothing where it failed."""
    scene = simulate(*arguments).get("scene")
    return scene if isinstance(scene, dict) else {}


def _virtual(
    app: str, places: Mapping[str, tuple[float, float, float]], values: Mapping[str, str], *arguments: str
) -> Mapping[str, Any]:
    """The same of a run in virtual time with these values of parameters, with `all_arrived` and `seconds`."""
    settings = [word for name, text in values.items() for word in ("--set", f"{name}={text}")]
    options = parse([app, *LINKS, *arguments, *settings, "--virtual"])
    scenario = build(options, PLACE)
    if places:
        simulation = replace(scenario.config.simulation, places=dict(places))
        scenario = replace(scenario, config=replace(scenario.config, simulation=simulation))
    outcome = VirtualRun(options, scenario).go()
    results = [path.value(path.last, "result.reached") for path in outcome.trajectories.values() if app == "goto"]
    return {**outcome.scene, "seconds": outcome.seconds, "all_arrived": all(each == 1 for each in results)}


def _figure(scene: Mapping[str, Any], name: str) -> float:
    value = scene.get(name)
    return float(value) if isinstance(value, int | float) else math.nan


def _worst(scenes: list[Mapping[str, Any]], name: str) -> float:
    return max(measured(_figure(scene, name) for scene in scenes))


def _closest(scenes: list[Mapping[str, Any]]) -> float:
    return min(measured(_figure(scene, "closest_m") for scene in scenes))
