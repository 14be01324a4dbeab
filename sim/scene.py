"""What the world saw of an app at work: figures for the report, app by app."""

from collections.abc import Mapping

from services.apps.core import formation
from sim.core.scene_record import SceneRecord
from sim.scenario import Scenario

Json = dict[str, object]

WATCHED = ("led_sync", "stand_up", "formation", "goto")
"""Apps of which there is something to see."""

CONTACT_M = 0.15
"""Distance between axles at which two robots touch."""
FORMED_M = 0.05
"""A formation with a smaller root mean square error is one."""


def seen(scenario: Scenario, scene_record: SceneRecord, began: float) -> Json:
    """Figures by name: times in s since `began`, lengths in m; only for apps of which there is something to see."""
    match scenario.app:
        case "led_sync":
            return _phases(scenario, scene_record, began)
        case "stand_up":
            return _wave(scenario, scene_record, began)
        case "formation":
            return _formation(scenario, scene_record, began)
        case "goto":
            return _closest(scene_record, began)
    return {}


def sentences(figures: Mapping[str, object]) -> list[str]:
    """The same for people."""
    return [f"{name.replace('_', ' '):<11} {_shown(value)}" for name, value in figures.items()]


def _phases(scenario: Scenario, scene_record: SceneRecord, began: float) -> Json:
    edges = scenario.config.edges
    phases = scene_record.phases(edges, began)
    at = None if phases is None else phases.synchronous_at
    if at is not None:
        phases = scene_record.phases(edges, at)
    return {
        "flashes": dict(scene_record.flashed),
        "synchronous_after_s": None if at is None else round(at - began, 2),
        "apart_neighbours_p95_ms": None if phases is None else round(1e3 * phases.neighbours, 2),
        "apart_all_p95_ms": None if phases is None else round(1e3 * phases.all, 2),
    }


def _wave(scenario: Scenario, scene_record: SceneRecord, began: float) -> Json:
    stood = scene_record.stood_at
    after = {}
    for name in sorted(stood, key=lambda name: stood[name])[1:]:
        before = [stood[other] for other in scenario.config.neighbours(name) if other in stood]
        after[name] = round(stood[name] - min(before), 2) if before and min(before) < stood[name] else None
    return {
        "stood_after_s": {name: round(t - began, 2) for name, t in sorted(stood.items(), key=lambda item: item[1])},
        "after_its_neighbour_s": after,
        "lies": [name for name in scene_record.names if name not in stood],
    }


def offsets_of(scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Each robot's place in the shape that the app `formation` was told, m."""
    names = scenario.config.names
    told = scenario.config.app("formation").of(names[0])
    shape, size = told.get("shape", formation.SHAPES[0]), told.get("size", formation.SIZE)
    assert isinstance(shape, str)
    assert isinstance(size, int | float)
    return {name: formation.offset(shape, i, len(names), float(size)) for i, name in enumerate(names)}


def _formation(scenario: Scenario, scene_record: SceneRecord, began: float) -> Json:
    misfits = scene_record.misfits(offsets_of(scenario))
    formed = None
    for t, misfit in reversed(misfits):
        if misfit > FORMED_M:
            break
        formed = t
    return {
        "misfit_m": round(misfits[-1][1], 4) if misfits else None,
        "formed_after_s": None if formed is None else round(formed - began, 1),
        **_closest(scene_record, began),
    }


def _closest(scene_record: SceneRecord, began: float) -> Json:
    closest = scene_record.closest
    if closest is None:
        return {"closest_m": None}
    return {
        "closest_m": round(closest.distance, 4),
        "closest_pair": f"{closest.a}-{closest.b}",
        "closest_after_s": round(closest.t - began, 1),
    }


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(item)}" for name, item in value.items()) or "-"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "-"
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
