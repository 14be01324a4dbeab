"""The diagnosis of a module, its settings and its anchors: each problem with a name and what to do about it.

`swarm dwm check` shows all of it; the service logs what its reports tell.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from math import dist, fsum, sqrt
from statistics import median

from services.dwm.core.estimation.multilateration import Fix, degenerate, multilaterate
from services.dwm.core.module.calls import RATE_UNIT, UWB_ACTIVE, ModuleStatus, Settings, UpdateRate, Version
from services.dwm.core.module.exchange import Trouble
from services.dwm.core.module.ranges import MAX_DISTANCE
from services.dwm.core.module.tlv import AnchorRange, Location
from swarm.config.types import Anchor
from swarm.frozen import frozen

FIRMWARE = (1, 3)
"""The firmware PANS R2, whose calls this project uses."""

ENOUGH = 3
"""Anchors that a place in the plane needs."""

AT_ONCE = 4
"""Modules that a tag ranges to at a time."""

MOVED = 0.02
"""Distance between an anchor's stored place and that of swarm.toml, from which on the anchor counts as set up
otherwise, m."""

MISFIT = 0.25
"""Root mean square of the residuals of median ranges, beyond which an anchor is not at its place of swarm.toml, m.
Uncalibrated ranges leave up to 0.1 m, and a hidden anchor about 0.3 m on one range."""

MEND = 0.4
"""Share of the misfit that remains at most when an anchor at a wrong place is left out."""

CONTRADICTION = 0.5
"""Length by which two ranges may break the triangle inequality with their anchors' distance, m: noise, or no line of
sight."""

TWO_PLACES = 0.6
"""Distance between two groups of ranges to one address, beyond which two modules have this address, m."""

EACH = 5
"""Least number of ranges in each group, which must also be a fifth of all: ranges around an obstacle are fewer."""

FEW = 0.5
"""Share of the answers in which something must be true to be reported."""

SIGMA = 0.05
"""Standard deviation of a good range, m."""

_ADVICE = {
    "silent": "check power and the wires (module TX to our RX, 3.3 V), and the port's name",
    "garbled": "115200 baud, 8N1; a common ground; a short wire",
    "shell": "it is sent quit; ask again. Programs that use its shell must be ended",
    "layout": "flash PANS R2 (DWM1001 firmware 1.3) with the maker's J-Flash or RTLS manager",
    "refused": "see `swarm dwm info`; a busy module is asked again by itself",
}


@frozen
class ModuleFinding:
    """One thing that is wrong."""

    code: str
    """Name of the finding."""
    text: str
    """What is wrong, with the numbers."""
    remedy: str
    """What to do."""
    fatal: bool = True
    """Whether localization does not work because of it."""


def of_trouble(trouble: Trouble) -> ModuleFinding:
    """Return the finding about a module that gives no proper answer."""
    codes = {"silent": "no-module", "garbled": "garbled", "shell": "shell-mode", "layout": "layout"}
    return ModuleFinding(codes.get(trouble.kind, trouble.kind), trouble.reason, _ADVICE[trouble.kind])


def of_version(version: Version) -> list[ModuleFinding]:
    """Check the module's firmware."""
    if version.firmware[:2] == FIRMWARE:
        return []
    return [
        ModuleFinding("firmware", f"its firmware is {version.text}, 1.3 is spoken here", _ADVICE["layout"], fatal=False)
    ]


def of_settings(settings: Settings, rate: UpdateRate, status: ModuleStatus, *, anchor: bool) -> list[ModuleFinding]:
    """Compare the module's settings with those desired of an `anchor` or a tag."""
    found = []
    configure = "`swarm dwm configure`"
    if settings.anchor != anchor:
        is_, shall = ("an anchor", "a tag") if settings.anchor else ("a tag", "an anchor")
        found.append(ModuleFinding("role", f"it is {is_} and shall be {shall}", configure))
    if settings.uwb != UWB_ACTIVE:
        found.append(ModuleFinding("uwb-off", f"its radio is {('off', 'passive')[settings.uwb == 1]}", configure))
    if settings.anchor:
        if not status.joined:
            found.append(_no_network())
        return found
    if rate.moving > 1:
        found.append(ModuleFinding("slow", f"it measures every {rate.moving * RATE_UNIT:g} s", configure))
    if settings.stationary and rate.still > rate.moving:
        period = rate.still * RATE_UNIT
        found.append(
            ModuleFinding("still", f"standing still, as balanced, it measures every {period:g} s only", configure)
        )
    if settings.low_power:
        found.append(ModuleFinding("low-power", "it sleeps between measurements and misses requests", configure))
    if not settings.engine:
        found.append(
            ModuleFinding("no-engine", "its location engine is off: ranges, but no place", configure, fatal=False)
        )
    if not status.joined:
        found.append(_no_network())
    return found


def _no_network() -> ModuleFinding:
    return ModuleFinding(
        "no-network",
        "it belongs to no network",
        "one anchor in reach must be initiator: `swarm dwm configure --anchor --initiator`; one network id for all",
    )


def of_anchors(anchors: Sequence[Anchor]) -> list[ModuleFinding]:
    """Return the anchors as swarm.toml has them."""
    if not anchors:
        return [
            ModuleFinding("no-anchors", "swarm.toml lists no [[anchors]]", "`swarm dwm anchors --auto`, or a ruler")
        ]
    if len(anchors) < ENOUGH:
        text = f"swarm.toml lists {len(anchors)} anchors, a place needs {ENOUGH}"
        return [ModuleFinding("few-anchors", text, "put up more anchors")]
    if (problem := degenerate([(a.x, a.y, a.z) for a in anchors])) is not None:
        return [ModuleFinding("collinear", f"swarm.toml: {problem}", "move one anchor well off the line of the others")]
    return []


def of_answers(
    locations: Sequence[Location],
    anchors: Sequence[Anchor],
    known: Mapping[str, str],
    own: str | None = None,
) -> list[ModuleFinding]:
    """Check a tag's answers of a few seconds against swarm.toml; the tag may move meanwhile.

    `known`: what other modules are (robots, target), by address; `own`: the tag's address.
    """
    if not locations:
        return []
    placed = {anchor.address: anchor for anchor in anchors}
    return [
        *_of_single_answers(locations, own),
        *_seen(locations, placed, known),
        *_said_elsewhere(locations[-1].ranges, placed),
    ]


def of_standing(
    locations: Sequence[Location],
    anchors: Sequence[Anchor],
    height: float = 0.0,
    calibrate: Callable[[str, float], float] = lambda _, distance: distance,
) -> list[ModuleFinding]:
    """Return the same of a tag that stands at `height` (m): what the distances say of the anchors.

    `calibrate(anchor, measured)` gives the distance, m.
    """
    placed = {anchor.address: anchor for anchor in anchors}
    ranges: dict[str, list[float]] = {}
    for location in locations:
        for item in location.ranges:
            if item.distance <= MAX_DISTANCE:
                ranges.setdefault(item.anchor, []).append(calibrate(item.anchor, item.distance))
    found = []
    split = {address for address, values in ranges.items() if _two_places(values)}
    for address in sorted(split):
        low, high = (median(half) for half in _halves(ranges[address]))
        found.append(
            ModuleFinding(
                "duplicate-address",
                f"ranges to {address} are at {low:.2f} m and at {high:.2f} m in turn: two modules of one address?",
                "read the addresses by `swarm dwm info --port ...` on each module and take one away",
            )
        )
    medians = {address: median(values) for address, values in ranges.items() if address in placed}
    return found + _misplaced({a: d for a, d in medians.items() if a not in split}, placed, height)


class DiagnosisWatch:
    """Holds a running service's reports against swarm.toml, every few seconds; tells what is new."""

    PERIOD = 5.0
    """Seconds of reports that are examined together."""

    def __init__(self, anchors: Sequence[Anchor], known: Mapping[str, str], now: float) -> None:
        self._anchors = anchors
        self._known = known
        self._due = now + self.PERIOD
        self._locations: list[Location] = []
        self._told: set[tuple[str, str]] = set()

    def report(self, location: Location, now: float) -> list[ModuleFinding]:
        """Take an answer; the findings that were not there the last time."""
        self._locations.append(location)
        if now < self._due:
            return []
        found = of_answers(self._locations, self._anchors, self._known)
        new = [finding for finding in found if (finding.code, finding.text) not in self._told]
        self._told = {(finding.code, finding.text) for finding in found}
        self._locations, self._due = [], now + self.PERIOD
        return new


def _of_single_answers(locations: Sequence[Location], own: str | None) -> list[ModuleFinding]:
    found = []
    twice: set[str] = set()
    far: dict[str, float] = {}
    for location in locations:
        seen = Counter(item.anchor for item in location.ranges)
        twice |= {address for address, count in seen.items() if count > 1}
        far |= {item.anchor: item.distance for item in location.ranges if item.distance > MAX_DISTANCE}
        if own is not None and own in seen:
            twice.add(own)
    for address in sorted(twice):
        text = f"{address} is there twice" + (", and is the address of this module" if address == own else "")
        found.append(ModuleFinding("duplicate-address", text, "take one of the two modules away, or reset its address"))
    for address, distance in sorted(far.items()):
        text = f"{distance:.1f} m to {address}: no UWB reaches so far"
        found.append(ModuleFinding("impossible-range", text, "power that anchor anew; replace it if it goes on"))
    return found


def _seen(locations: Sequence[Location], placed: Mapping[str, Anchor], known: Mapping[str, str]) -> list[ModuleFinding]:
    """Check which anchors the answers hold, and whether the module computes a place from them."""
    times = Counter(item.anchor for location in locations for item in {r.anchor: r for r in location.ranges}.values())
    often = {address for address, count in times.items() if count >= FEW * len(locations)}
    found = []
    for address in sorted(times.keys() - placed.keys() - known.keys()):
        text = f"{address} gives ranges and is not in swarm.toml"
        found.append(ModuleFinding("unknown-anchor", text, "add it to [[anchors]], or to a robot as uwb", fatal=False))
    for address in sorted(placed.keys() - times.keys()):
        text = f"anchor {address} of swarm.toml gives no range"
        remedy = "is it powered, an anchor (`swarm dwm configure --anchor`), in reach? A tag ranges to four at most"
        found.append(ModuleFinding("missing-anchor", text, remedy, fatal=False))
    good = often & placed.keys()
    if not times:
        remedy = "are anchors powered, is one of them the initiator, is the network id the same for all?"
        return [*found, ModuleFinding("no-ranges", "no anchor gives any range", remedy)]
    if len(good) < ENOUGH:
        text = f"{len(good)} anchors give ranges ({', '.join(sorted(good)) or 'none'}), a place needs {ENOUGH}"
        others = sorted(often - placed.keys())
        if others and len(often) >= AT_ONCE:
            text += f"; a tag ranges to {AT_ONCE} modules, and {', '.join(others)} take {len(others)} of these places"
        return [*found, ModuleFinding("few-anchors", text, "put up more anchors, or bring them into sight")]
    places = [(placed[a].x, placed[a].y, placed[a].z) for a in sorted(good)]
    if (problem := degenerate(places)) is not None:
        text = f"the anchors in sight ({', '.join(sorted(good))}): {problem}"
        found.append(ModuleFinding("collinear", text, "move one anchor well off the line of the others"))
    if sum(location.position.quality > 0 for location in locations) < FEW * len(locations):
        text = "the module makes no place of its ranges (quality 0)"
        remedy = "set the anchors' places on them: `swarm dwm configure --anchor --port ...` on each"
        found.append(ModuleFinding("no-fix", text, remedy, fatal=False))
    return found


def _said_elsewhere(ranges: Sequence[AnchorRange], placed: Mapping[str, Anchor]) -> list[ModuleFinding]:
    """Anchors that were set up to be elsewhere than swarm.toml has them."""
    found = []
    for item in ranges:
        anchor, said = placed.get(item.anchor), item.position
        if anchor is None or said.quality == 0:
            continue
        if dist((anchor.x, anchor.y, anchor.z), (said.x, said.y, said.z)) > MOVED:
            text = (
                f"anchor {item.anchor} says it is at ({said.x:.2f}, {said.y:.2f}, {said.z:.2f}) m, "
                f"swarm.toml has ({anchor.x:.2f}, {anchor.y:.2f}, {anchor.z:.2f}) m"
            )
            remedy = (
                "the module's own places are off: `swarm dwm configure --anchor --port ...` on it, or mend swarm.toml"
            )
            found.append(ModuleFinding("anchor-setup", text, remedy, fatal=False))
    return found


def _misplaced(medians: Mapping[str, float], placed: Mapping[str, Anchor], height: float) -> list[ModuleFinding]:
    """Ranges that no place fits: an anchor was moved since, or is hidden."""
    found = []
    names = sorted(medians)
    for number, one in enumerate(names):
        for other in names[number + 1 :]:
            a, b = placed[one], placed[other]
            apart = dist((a.x, a.y, a.z), (b.x, b.y, b.z))
            beyond = abs(medians[one] - medians[other]) - apart, apart - medians[one] - medians[other]
            if max(beyond) > CONTRADICTION:
                text = (
                    f"{medians[one]:.2f} m to {one} and {medians[other]:.2f} m to {other}, "
                    f"which are {apart:.2f} m apart in swarm.toml: impossible"
                )
                found.append(
                    ModuleFinding("impossible-range", text, "is one of them elsewhere than swarm.toml has it?")
                )
    misfit = _misfit(names, medians, placed, height)
    if misfit is None or misfit <= MISFIT:
        return found
    text = f"no place fits the ranges: {misfit:.2f} m rms"
    remedy = "measure the anchors' places anew (`swarm dwm anchors --auto`) and calibrate anew"
    if len(names) > ENOUGH:
        without = ((_misfit([n for n in names if n != name], medians, placed, height), name) for name in names)
        fitting = sorted((rest, name) for rest, name in without if rest is not None and rest < MEND * misfit)
        if fitting:
            words = " or ".join(f"without {name} ({rest:.2f} m)" for rest, name in fitting)
            text += f"; one does {words}: moved, or hidden"
    return [*found, ModuleFinding("anchor-moved", text, remedy)]


def _misfit(
    names: Sequence[str], medians: Mapping[str, float], placed: Mapping[str, Anchor], height: float
) -> float | None:
    """Root of the mean squared residual of the best place, m; None where there is none."""
    places = [(placed[name].x, placed[name].y, placed[name].z) for name in names]
    fix = multilaterate(places, [medians[name] for name in names], height, SIGMA)
    if not isinstance(fix, Fix):
        return None
    return sqrt(fsum(residual**2 for residual in fix.residuals) / len(names))


def _halves(values: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
    """Return the values split at their widest gap."""
    ordered = sorted(values)
    at = max(range(1, len(ordered)), key=lambda i: ordered[i] - ordered[i - 1])
    return ordered[:at], ordered[at:]


def _two_places(values: Sequence[float]) -> bool:
    """Return whether they come from two distances in turn."""
    if len(values) < 2 * EACH:
        return False
    low, high = _halves(values)
    each = min(len(low), len(high))
    return each >= max(EACH, 0.2 * len(values)) and median(high) - median(low) > TWO_PLACES
