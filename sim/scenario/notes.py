"""The notes that a simulated run prints before it starts: limits of real robots that it exceeds, step sizes, buttons
that it waits for, states that will be lost.

A state or message too large for a frame is refused by simulations, too, where the app is loaded.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from services.apps import loader
from services.apps.builtin.localization.guard import check_step_size, limit_step_size
from services.mesh.core.routing.physical_links import links_of, physical
from sim.scenario import imports
from sim.scenario.builtin_apps import defaults_of
from sim.scenario.options import Options
from swarm.app.event_app import EventApp, channels_of
from swarm.config.types import MAX_RFCOMM_LINKS, Config
from swarm.core.graph import Edge, Graph
from swarm.errors import AppError
from swarm.recording.thesis_ranges import ThesisRecording

STANDS_M = 0.25
"""Largest distance of a recorded place from the robot's place, m: the thesis' own are up to 9 cm off."""


def notes(
    config: Config,
    given: Config,
    apps: tuple[loader.LoadedApp, ...],
    options: Options,
    recordings: Mapping[str, ThesisRecording],
) -> Iterator[str]:
    """Yield the notes on a run with `config`; `given` is the swarm's own configuration.

    `recordings` are those that are replayed, by robot.
    """
    rows = min((len(each.rows) for each in recordings.values()), default=None)
    if rows is not None and options.iterations is not None and options.iterations > rows:
        yield f"the recordings have {rows} rows: the run ends after {rows} iterations"
    # Where nobody has named the places, the table's need not be those of the recording.
    if not given.simulation.places:
        yield from (f"warning: {each}" for each in exchanged(config.simulation.places, recordings))
    if not config.auto:
        yield from too_many_links(config.names, config.edges, links_of(config, bluetooth=True))
    for app in apps:
        # Without a configuration no robots are meant. `swarm check` and `swarm run` tell it, too. A notebook's cell is
        # no file.
        if options.config is not None and not app.is_built_in and Path(app.source).is_file():
            yield from imports.missing_imports(app.source, (*given.packages, *imports.own_packages()))
        yield from _step_size(config, app, recordings)
        yield from _buttons(app, options)
        yield from forgetting(config, app, options)
        yield from _clocks(app, options)


def exchanged(
    places: Mapping[str, tuple[float, float, float]], recordings: Mapping[str, ThesisRecording]
) -> Iterator[str]:
    """Yield which recordings were made at each other's place, of two robots that `places` gives one."""
    for one, other in combinations([name for name in recordings if name in places], 2):
        own, theirs = (recordings[name].rows[0][1:] for name in (one, other))
        here, there = (places[name][:2] for name in (one, other))
        if max(math.dist(own, there), math.dist(theirs, here)) <= STANDS_M < math.dist(own, here):
            yield (
                f"{recordings[one].path} was recorded at the place of {other}, {recordings[other].path} at that of "
                f"{one}: likely the files were exchanged; <index>.csv is of the robot with that number"
            )


def too_many_links(names: Sequence[str], edges: Sequence[Edge], links: str) -> Iterator[str]:
    """Tell which robots have more links than a Bluetooth radio holds; `links` is the way they carry the topology."""
    counts = Counter(name for edge in physical(names, edges, links) for name in edge)
    crowded = [name for name in names if counts[name] > MAX_RFCOMM_LINKS]
    if crowded:
        most = max(counts.values())
        yield (
            f"real robots would refuse this topology: {', '.join(crowded[:6])}{', ...' if len(crowded) > 6 else ''} "
            f"with up to {most} links, and a Bluetooth radio holds {MAX_RFCOMM_LINKS}; --links tree carries it"
        )


def algorithm_of(config: Config, app: loader.LoadedApp) -> str | None:
    """Return the algorithm that the app runs, None where it has no choice. `check` has made sure that all robots run
    the same."""
    if "" in app.algorithms:
        return None
    return str(config.app(app.name).of(config.names[0]).get("algorithm", next(iter(app.algorithms))))


def _step_size(config: Config, app: loader.LoadedApp, recordings: Mapping[str, ThesisRecording]) -> tuple[str, ...]:
    """Hold gradient tracking's step size against the limit of this graph and geometry.

    One above it is refused, but in a replay, where the places are those of the recording, and with `check = false` it
    is only told. Of an automatic topology nobody knows the graph yet.
    """
    algorithm = algorithm_of(config, app)
    if app.name != "localization" or not app.is_built_in or algorithm not in ("thesis", "diging") or config.auto:
        return ()
    made: Any = app.make(config, config.names[0])
    gamma = made.step_size
    places = {name: (x, y) for name, (x, y, _) in config.simulation.places.items()}
    places |= {name: (recording.rows[0].x, recording.rows[0].y) for name, recording in recordings.items()}
    graph = Graph(config.names, config.edges)
    limit = limit_step_size(graph, places, config.simulation.target, metropolis=algorithm == "diging")
    told = (
        f"step size {gamma * 1e-4:.3g} 1/cm^2 = {gamma:.3g} 1/m^2, limit {limit * 1e-4:.3g} 1/cm^2 = {limit:.3g} 1/m^2"
    )
    try:
        warning = check_step_size(gamma, limit)
    except AppError as error:
        if made.check and not recordings:
            raise
        warning = str(error)
    return (told, f"warning: {warning}") if warning else (told,)


def _buttons(app: loader.LoadedApp, options: Options) -> tuple[str, ...]:
    """Return a note if the app waits for a button."""
    if not defaults_of(app).waits_for_button or options.presses:
        return ()
    return (f"{app.name} waits for a button: swarm hand press r0 A, from another terminal, or --press r0.A@2s",)


def forgetting(config: Config, app: loader.LoadedApp, options: Options) -> tuple[str, ...]:
    """Return a note if a lockstep will not go on by itself with a robot that is switched off."""
    kind = app.kind_on(config, config.names[0])
    lockstep = not issubclass(kind, EventApp) or bool(channels_of(kind))
    off = next((each for each in options.offs if each.at is not None), None)
    if off is None or options.run_options.drop or not lockstep:
        return ()
    return (
        f"{off}: {app.name} has lost its state there afterwards, and the others wait for it; --absent drop goes on "
        '(absent="drop" in a program)',
    )


def _clocks(app: loader.LoadedApp, options: Options) -> tuple[str, ...]:
    if not defaults_of(app).clock_skew or options.app != app.name or not options.clock_skew:
        return ()
    return (
        f"each robot has a clock of its own, up to {options.clock_skew * 1e6:g} ppm off; --clock-skew changes that",
    )
