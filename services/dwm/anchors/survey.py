"""Distances between anchors, to lay them out automatically.

An anchor ranges to nobody. Its `loc_get` tells distances to other anchors only after the phone app's auto-positioning,
which starts over Bluetooth alone. What works over the serial line is what that does inside: each anchor in turn becomes
a tag for a while (`take_turns`). Or a tag is carried from anchor to anchor and held beside each (`beside`).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from statistics import median

from services.dwm.configure import DesiredModule as _Wish
from services.dwm.configure import ModuleInfo, inspect, wanted
from services.dwm.core.module import calls
from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location
from services.dwm.line import ModuleConnection, restart
from swarm import clock
from swarm.errors import LocalError, RemoteError

Pair = tuple[str, str]
Calibrate = Callable[[str, float], float]
Say = Callable[[str], None]

SECONDS = 5.0
"""Seconds of ranging at each place: some 50 ranges, whose median errs by a centimetre."""

LEAST = 5
"""Least number of ranges to an anchor for a median."""

PERIOD = 0.1


def sample(line: ModuleConnection, seconds: float, wait: Callable[[float], None]) -> list[Location]:
    """Return the module's different answers over a while; raises `NoAnswerError`."""
    found: list[Location] = []
    end = clock.now() + seconds
    due = clock.now()
    while clock.now() < end:
        location = line.ask(LOC_GET)
        if not found or location != found[-1]:
            found.append(location)
        due = max(due + PERIOD, clock.now())
        wait(due - clock.now())
    return found


def medians(locations: Iterable[Location], calibrate: Calibrate) -> dict[str, float]:
    """Distance to each module that gave enough ranges, m."""
    ranges: dict[str, list[float]] = {}
    for location in locations:
        for item in location.ranges:
            ranges.setdefault(item.anchor, []).append(calibrate(item.anchor, item.distance))
    return {address: median(values) for address, values in ranges.items() if len(values) >= LEAST}


def take_turns(
    lines: Sequence[ModuleConnection], seconds: float, calibrate: Calibrate, wait: Callable[[float], None], say: Say
) -> dict[Pair, float]:
    """Measure all distances where every anchor is connected here: each one is the tag for `seconds`.

    Another one keeps the network while the initiator has its turn. Every module ends as it was found, but for the
    update rate of an anchor: that holds for tags alone, and stays at that of its turn. Raises `NoAnswerError`,
    `LocalError`.
    """
    modules = {line: inspect(line) for line in lines}
    addresses = [info.address for info in modules.values()]
    if len(set(addresses)) < len(addresses):
        raise LocalError(f"two of the modules have one address: {', '.join(addresses)}")
    distances: dict[Pair, float] = {}
    for line, info in modules.items():
        others = [other for other in lines if other is not line]
        deputy = others[0] if info.settings.initiator else None
        say(f"{info.address} ({line.name}) takes its turn")
        try:
            if deputy is not None:
                _set(deputy, replace(modules[deputy].settings, anchor=True, initiator=True))
            _set(line, wanted(info.settings, _Wish(anchor=False)))
            line.ask(calls.upd_rate_set(calls.UpdateRate(1, 1)))
            found = medians(sample(line, seconds, wait), calibrate)
        finally:
            _restore({each: modules[each] for each in (line, deputy) if each is not None})
        distances |= _row(info.address, found, set(addresses))
    return distances


def _set(line: ModuleConnection, settings: calls.Settings) -> None:
    line.ask(calls.cfg_set(settings))
    restart(line)


def _restore(found: Mapping[ModuleConnection, ModuleInfo]) -> None:
    """Let each module be as it was, also where another one does not answer. Raises `LocalError` that names those which
    are left changed."""
    left = []
    for line, info in found.items():
        try:
            _set(line, info.settings)
            if not info.settings.anchor:
                line.ask(calls.upd_rate_set(info.rate))
        except (LocalError, RemoteError) as error:
            left.append(
                f"{info.address} ({line.name}) is not as it was: {error}; mend it by swarm dwm configure --anchor"
                f"{' --initiator' if info.settings.initiator else ''} --port {line.name}"
            )
    if left:
        raise LocalError("; ".join(left))


def _row(address: str, found: Mapping[str, float], anchors: set[str]) -> dict[Pair, float]:
    return {(address, other): distance for other, distance in found.items() if other in anchors and other != address}


def beside(
    line: ModuleConnection,
    anchors: Sequence[str],
    seconds: float,
    calibrate: Calibrate,
    wait: Callable[[float], None],
    ask: Say,
) -> dict[Pair, float]:
    """Measure with a tag that a person holds beside each anchor in turn."""
    distances: dict[Pair, float] = {}
    for address in anchors:
        ask(f"hold the tag's antenna beside anchor {address}, at its height")
        distances |= _row(address, medians(sample(line, seconds, wait), calibrate), set(anchors))
    return distances


def surveyed(infos: Mapping[str, Sequence[AnchorRange]], calibrate: Calibrate) -> dict[Pair, float]:
    """Return the distances that anchors tell of each other after the phone app's auto-positioning."""
    return {
        (address, item.anchor): calibrate(item.anchor, item.distance)
        for address, ranges in infos.items()
        for item in ranges
        if item.anchor in infos and item.anchor != address
    }
