"""The figures of the world for a run's report: those of each app, and how near robots came."""

from collections.abc import Callable, Mapping

from services.apps.core import formation
from services.balancer.core.control.body import body_model
from sim.core.contacts import Contacts
from sim.core.scene_record import SceneRecord
from sim.scenario.scenario import Scenario
from swarm.config import Config

Json = dict[str, object]

NEARNESS = ("closest_m", "closest_pair", "closest_after_s", "contacts", "touched", "fell_by_contact")
"""Figures of how near robots came."""
WORDS = (("touched", "touched"), ("fell", "fell_by_contact"))
MOST_LISTED = 5
"""Contacts that the report for people names."""
FORMED_M = 0.05
"""Root mean square error below which a formation counts as formed, m."""


def contacts_of(config: Config) -> Contacts:
    """Return the contacts of robots that touch, with their masses."""
    models = {name: body_model(config.robot(name).board, config.body_of(name)) for name in config.names}
    return Contacts({name: model.mass + model.wheel_mass for name, model in models.items()})


def seen(
    scenario: Scenario, scene_record: SceneRecord | None, contacts: Contacts, began: float, started: float | None
) -> Json:
    """Return figures by name: times in s, lengths in m. Those of an app count from `began`, the command, and those of
    robots that are near each other from `started`, the first iteration of all robots. `scene_record` is None where the
    app is not `WATCHED`; without a contact, `contacts` is 0 and the names of contacts and falls are left out."""
    figures = WATCHED.get(scenario.built_in or "")
    found = figures(scenario, scene_record, began) if figures is not None and scene_record is not None else {}
    return found | _near(contacts, began if started is None else started)


def sentences(figures: Mapping[str, object]) -> list[str]:
    """Return the figures as sentences for people."""
    lines = [f"{name.replace('_', ' '):<11} {_shown(value)}" for name, value in figures.items() if name not in NEARNESS]
    if "closest_m" in figures:
        when = _shown(figures["closest_after_s"])
        contacts = figures["contacts"] or "no"
        met = f"{contacts} contact{'' if contacts == 1 else 's'}"
        lines.append(f"nearest     {_shown(figures['closest_m'])} m, {figures['closest_pair']} after {when} s; {met}")
        lines += [f"{name:<11} {_listed(figures[key])}" for name, key in WORDS if key in figures]
    return lines


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
    """Return each robot's place in the shape of the app `formation`, m."""
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
    }


WATCHED: Mapping[str, Callable[[Scenario, SceneRecord, float], Json]] = {
    "led_sync": _phases,
    "stand_up": _wave,
    "formation": _formation,
}
"""Built-in apps of which there is more to see than how near robots came, and their figures."""


def _near(contacts: Contacts, started: float) -> Json:
    def after(t: float) -> float:
        return max(0.0, round(t - started, 1))

    closest = contacts.closest
    if closest is None:
        return {}  # one robot alone
    found: Json = {
        "closest_m": round(closest.distance, 4),
        "closest_pair": f"{closest.a}-{closest.b}",
        "closest_after_s": after(closest.t),
        "contacts": contacts.count,
    }
    if contacts.count:
        found["touched"] = [
            f"{each.a}-{each.b} after {after(each.t):.1f} s at {each.speed:.2f} m/s" for each in contacts.contacts
        ]
    if contacts.fallen:
        found["fell_by_contact"] = [f"{robot} after {after(t):.1f} s" for t, robot in contacts.fallen]
    return found


def _listed(entries: object) -> str:
    assert isinstance(entries, list)
    more = f" (--json has more: {len(entries)})" if len(entries) > MOST_LISTED else ""
    return "; ".join(entries[:MOST_LISTED]) + more


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(item)}" for name, item in value.items()) or "-"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "-"
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
