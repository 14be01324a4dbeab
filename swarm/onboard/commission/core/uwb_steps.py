"""Steps of the UWB module: who is heard, and by how much all of this robot's ranges are too long."""

import math
from collections import defaultdict
from collections.abc import Generator
from statistics import fmean, median, pstdev

from swarm.messages import Range
from swarm.onboard.commission.core.procedure import Desk, Script, StepError

RANGES_S = 5.0
FEWEST_REPORTS = 10
SHARES = ((0.5, 0.5), (0.25, 0.65), (0.75, 0.35))
"""The places to measure at, as shares of the box around the anchors. Multipath gives each place an error of its own, so
one place is not enough."""
SMALLEST_BOX = 0.5
"""Least side of the box, m: in a narrower field the places would hardly differ."""
SETTLE_S = 2.0
"""Seconds to wait at a new place: the service's average may still contain ranges of the place before."""
FEWEST_RANGES = 10
LARGEST_OFFSET = 0.5
"""Largest offset that is accepted, m (`services/dwm/core/calibration/limits.py`)."""
LARGEST_SPREAD = 0.4
"""Length by which the error of one anchor may differ from the others, m."""


def uwb(desk: Desk) -> Script:
    """Check that each anchor of the configuration is heard."""
    yield from desk.confirm(
        "lay-in-sight", "Lay the robot on its back in sight of the anchors, and leave it. A or Enter when it lies."
    )
    anchors = desk.subject.anchors
    heard = yield from _heard(desk)
    rows = {name: [each.raw for each in heard[name]] for name in anchors if len(heard[name]) >= 2}
    desk.figures["reports_hz"] = round(len(desk.robot.ranges) / RANGES_S, 1)
    desk.figures["anchors"] = {
        name: {
            "range_m": round(fmean(row), 3),
            "deviation_m": round(pstdev(row), 4),
            "hz": round(len(row) / RANGES_S, 1),
        }
        for name, row in rows.items()
    }
    if not anchors:
        desk.say("swarm.toml names no anchors: nothing to hear")
        return
    if len(desk.robot.ranges) < FEWEST_REPORTS:
        raise StepError("the DWM1001 gives no reports", "swarm dwm check; the wiring of RX, TX and 3V3")
    if missing := [name for name in anchors if name not in rows]:
        raise StepError(
            f"not heard: anchor {', '.join(missing)}",
            "is it powered, in sight and an anchor of this network? swarm dwm info --port /dev/ttyACM0 at it",
        )


def offset(desk: Desk) -> Script:
    """Measure the mean error of the robot's ranges at places that are known, under the calibration in use."""
    places = _places(list(desk.subject.anchors.values()))
    if not places:
        desk.say("the anchors of swarm.toml span no field: no offset is learned")
        return
    errors: defaultdict[str, list[float]] = defaultdict(list)
    for number, (x, y) in enumerate(places, 1):
        question = (
            f"Lay it on its back, its UWB module at x = {x:g} m, y = {y:g} m (place {number} of {len(places)}). "
            "A or Enter when it lies. C or n: leave the offset out."
        )
        if not (yield from desk.question(f"lay-at {x:g} {y:g}", question)):
            desk.say("no offset is learned: until it is, positions are some centimetres less exact")
            return
        yield from _measure(desk, (x, y), errors)
    by_anchor = {name: fmean(found) for name, found in errors.items()}
    learned = fmean(by_anchor.values())
    desk.figures |= {
        "range_offset_m": round(learned, 4),
        "anchor_errors_m": {name: round(error, 3) for name, error in sorted(by_anchor.items())},
        "places": len(places),
    }
    strange = max(by_anchor, key=lambda name: abs(by_anchor[name] - median(by_anchor.values())))
    if abs(by_anchor[strange] - median(by_anchor.values())) > LARGEST_SPREAD:
        raise StepError(
            f"ranges to anchor {strange} are {by_anchor[strange]:+.2f} m off, those to the others are not",
            f"does {strange} stand where swarm.toml says? else something hides it: move it into sight",
        )
    if abs(learned) > LARGEST_OFFSET:
        raise StepError(
            f"ranges are {learned:+.2f} m too long on the mean, and no module errs by more than {LARGEST_OFFSET:g} m",
            "lay it at the places that are named; do the anchors stand where swarm.toml says?",
        )


def _measure(desk: Desk, place: tuple[float, float], errors: defaultdict[str, list[float]]) -> Script:
    """Add the error of the middle range to each anchor that is heard at this place, m."""
    yield from desk.wait(SETTLE_S)
    heard = yield from _heard(desk)
    found = {name: [each.distance for each in row] for name, row in heard.items() if len(row) >= FEWEST_RANGES}
    if not found:
        raise StepError(
            f"no anchor is heard often enough at ({place[0]:g}, {place[1]:g}) m",
            "is the robot in sight of the anchors? Try swarm dwm check",
        )
    for name, distances in found.items():
        errors[name].append(median(distances) - math.dist((*place, 0.0), desk.subject.anchors[name]))


def _heard(desk: Desk) -> Generator[None, None, dict[str, list[Range]]]:
    """Listen for `RANGES_S` and return the fresh ranges to each anchor of the configuration, each measurement once."""
    desk.robot.ranges.clear()
    yield from desk.wait(RANGES_S)
    heard: dict[str, dict[int, Range]] = {name: {} for name in desk.subject.anchors}
    for report in desk.robot.ranges:
        for each in report.ranges:
            if not each.stale and each.anchor in heard:
                heard[each.anchor][each.sequence] = each
    return {name: list(row.values()) for name, row in heard.items()}


def _places(anchors: list[tuple[float, float, float]]) -> list[tuple[float, float]]:
    """Return places within the anchors' box, to the decimetre; none where it is too narrow."""
    if not anchors:
        return []
    (low_x, high_x), (low_y, high_y) = ((min(row), max(row)) for row in list(zip(*anchors, strict=True))[:2])
    if min(high_x - low_x, high_y - low_y) < SMALLEST_BOX:
        return []
    return [(round(low_x + (high_x - low_x) * a, 1), round(low_y + (high_y - low_y) * b, 1)) for a, b in SHARES]
