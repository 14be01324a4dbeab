"""The scenario from the options: the config of a simulated swarm with its robots, their places and app parameters.

The default scene is the thesis' table (figure 4.8): 2 m x 2 m, three anchors, the target at (0.5, 1.0), robots 0-2 at
its three places. The simulated modules read as its modules did, so the thesis' calibration is what the robots use.
"""

import math
import random
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from services.apps import loader
from services.mesh.core.routing.physical_links import links_of, physical
from sim.core import noise
from sim.core.module_line import SOURCE, module_address
from sim.disturbances import Disturbance, Kill, Off, drawn
from sim.scenario import commission_report
from sim.scenario.builtin_apps import defaults_of
from sim.scenario.notes import algorithm_of, exchanged, notes
from sim.scenario.options import Options
from swarm import config as configuration
from swarm.app.event_app import EventApp, PeriodicApp
from swarm.app.run_options import RunOptions
from swarm.app.settings import on_top
from swarm.app.sync_app import BaseApp
from swarm.config import Affine, Anchor, AppConfig, Config, Dwm, Linear, MeshConfig, RobotConfig, SimulationConfig
from swarm.config.load import AUTO, wrong_links
from swarm.config.types import DEFAULT_RELAY
from swarm.core.graph import Edge, Graph
from swarm.errors import ConfigError, LocalError
from swarm.frozen import frozen
from swarm.messages.codec import Value
from swarm.process.paths import socket_path
from swarm.recording.thesis_ranges import ThesisRecording, mismatches, read_folder

TARGET = "C933"
ANCHORS = (Anchor("D001", 0.0, 0.0), Anchor("D002", 1.94, 0.0), Anchor("D003", 1.0, 1.94))
"""Thesis figure 2.9 (the applications' scripts write the second as 1.97); addresses are ours."""

PLACES = ((0.5, 1.5), (1.0, 0.5), (1.5, 1.5), (1.5, 0.5), (0.35, 0.4), (1.0, 1.75))
"""m; the first three are the thesis' (figure 4.8), no three on a line with the target, none nearer than 0.5 m to it."""

DISTANCE = Linear(0.946976, -0.05964849)
POSITION = Affine(((0.93538932, 0.00353817), (-0.01071457, 0.94470965)), (0.046239576, 0.050861534))
"""The thesis' calibrations, equations 2.8 and 2.10 with the digits its programs used."""

WINDOW = 30
"""Measurements averaged, as in the thesis' run of figure 4.10 (b): simulated robots stand in their places."""

START_VALUES = {3: (0.5, 3.0, 5.0), 6: (0.5, 1.0, 2.0, 3.0, 4.0, 5.0)}
"""The thesis' starting values of consensus (figure 4.4)."""

MOST_ITERATIONS = 10_000
"""The most iterations of a run until it has converged, where nothing else ends it."""

VIRTUAL_SERVICES = ("mesh", "app")
"""Services that can be killed under virtual time."""

NOISE = "noise"
"""Folder of a run for measurements that were made up."""

SHORTEST_ITERATION = 1e-3
"""Shortest iteration, s, by which a run that ends by its time gets a number of measurements."""


class Beside(NamedTuple):
    """An app that each robot runs beside the one that the run is about: as long as that one does."""

    app: str
    program: str
    """What the app host is started with: a name or a path."""
    loaded: loader.LoadedApp


@frozen
class Scenario:
    """A run, ready to start."""

    config: Config
    app: str | None
    """The app's name, as in keys and in swarm.toml."""
    program: str | None
    """What the app host is started with: the name of a built-in app, or the path of a file."""
    loaded: loader.LoadedApp | None
    """The app itself."""
    algorithm: str | None
    """The algorithm the app runs, None where the app has no such parameter."""
    topology: str
    iterations: int | None
    run_options: RunOptions
    """The rules of its lockstep, `iterations` and all."""
    recordings: dict[str, ThesisRecording]
    """The recordings by robot, with those that --noise makes up."""
    synthetic: bool
    """Whether they were made up: then there are no estimates to compare with."""
    mismatches: tuple[str, ...]
    """What is wrong with recordings that can be replayed all the same, with file and likely reason."""

    beside: tuple["Beside", ...]
    """The other apps that each robot runs."""

    steps: bool
    """Whether the app has iterations; one that only reacts to events has none."""

    disturbances: tuple[Disturbance, ...]
    """The events that happen to robots and links, with robots and times drawn by the seed."""
    lying: str | None
    """The side on which the robots lie at the start; None: they stand up by themselves."""

    notes: tuple[str, ...]
    """Lines to print before the simulation starts."""

    @property
    def built_in(self) -> str | None:
        """The name of the built-in app that runs; None for an author's own, which may have the same name."""
        return self.app if self.loaded is not None and self.loaded.is_built_in else None

    @property
    def run_options_beside(self) -> RunOptions:
        """Return the options of other apps: they run as long as the first one, or as there are measurements for
        them."""
        return replace(self.run_options, last=self.iterations if self.recordings else None, rule=None)

    @property
    def late(self) -> dict[str, float]:
        """Robots that come later than the others, and by how many s."""
        return {each.robot: each.seconds for each in self.disturbances if isinstance(each, Off) and each.at is None}

    @property
    def recorded(self) -> dict[str, ThesisRecording]:
        """The recordings of real robots, with their estimates."""
        return {} if self.synthetic else self.recordings

    @property
    def parameters(self) -> dict[str, dict[str, Value]]:
        """The app's parameters by robot."""
        return {name: self.config.app(self.app or "").of(name) for name in self.config.names}


def build(options: Options, run_dir: Path, app: loader.LoadedApp | None = None) -> Scenario:
    """Return the scenario of `options` with its sockets in `run_dir`; raises `ConfigError` or `RecordingError`.

    `app`: the one that `options.app` names, where it is there already."""
    recordings = read_folder(options.replay) if options.replay is not None else []
    if options.config is not None:
        # Simulated robots have links of their own, so a file that `swarm pair` has not completed yet does.
        base = configuration.load(options.config, addressed=False)
    else:
        base = _default(options, len(recordings))
    if recordings and len(recordings) != len(base.robots):
        raise ConfigError(f"{options.replay} holds {len(recordings)} robots, the swarm has {len(base.robots)}")
    if app is None and options.app is not None:
        app = loader.load(options.app)
    apps = _apps(app, options)
    kind = "sim" if options.slots is None else "slots"
    config = replace(
        base,
        robots=tuple(
            replace(
                robot,
                link=f"{kind}:{socket_path(run_dir / robot.name, 'mesh.sock')}",
                uwb=robot.uwb or module_address(index),
            )
            for index, robot in enumerate(base.robots)
        ),
        mesh=replace(base.mesh, insecure=True, key=None, listen=None, links=options.links or base.mesh.links),
        dwm=_dwm(base, options.replay, run_dir),
        simulation=_places(base),
    )
    if problem := wrong_links(config.mesh.links, len(config.robots), auto=config.auto):
        raise ConfigError(f"--links: {problem}")
    if options.target_velocity is not None:
        # An average over three seconds would be of places that the target has left.
        moving = replace(config.simulation, target_velocity=options.target_velocity)
        config = replace(config, simulation=moving, dwm=replace(config.dwm, window=1, position_window=WINDOW))
    if options.like is not None:
        config = commission_report.apply(config, options.like)
    for each in apps:
        parameters = _parameters(config, each, options, first=each is app)
        config = replace(config, apps={**config.apps, each.name: parameters})
        each.check(config)
    disturbances = _disturbances(config, options)
    if app is not None:
        _check_end(config, app, options)
        _check_measured(config, apps, options)
    iterations = options.iterations
    rule = options.run_options.rule
    if app is not None and iterations is None and options.seconds is None and (rule is None or rule.seconds is None):
        iterations = defaults_of(app).iterations if rule is None else MOST_ITERATIONS
    if recordings:
        rows = min(len(recording.rows) for recording in recordings)
        iterations = rows if options.iterations is None else min(rows, options.iterations)
    recorded = dict(zip(config.names, recordings, strict=False))
    if options.noise is not None:
        recorded = _study(config, options, iterations, run_dir)
        config = replace(config, dwm=replace(config.dwm, source=f"replay:{run_dir / NOISE}"))
    sides = (side for each in apps if (side := defaults_of(each).lying) is not None)
    return Scenario(
        config=config,
        app=app.name if app is not None else None,
        program=_program(app) if app is not None else None,
        loaded=app,
        algorithm=algorithm_of(config, app) if app is not None else None,
        topology=options.topology or ("file" if options.config is not None else "line"),
        iterations=iterations,
        run_options=replace(options.run_options, last=iterations),
        recordings=recorded,
        synthetic=options.noise is not None,
        mismatches=(*mismatches(recordings), *exchanged(base.simulation.places, recorded)) if recordings else (),
        beside=tuple(Beside(each.name, _program(each), each) for each in apps[1:]),
        steps=app is not None and not _reacts_only(app.kind_on(config, config.names[0])),
        disturbances=disturbances,
        lying=options.lying or next(sides, None),
        notes=tuple(notes(config, base, apps, options, {} if options.noise else recorded)),
    )


def _disturbances(config: Config, options: Options) -> tuple[Disturbance, ...]:
    """Return the disturbances, with robots and times that the seed has drawn."""
    kinds = (options.presses, options.cuts, options.offs, options.kills, options.pushes)
    links: Collection[Edge] = ()
    if options.cuts:  # an automatic topology may link any two robots
        carrying = physical(config.names, config.edges, links_of(config))
        links = tuple(combinations(config.names, 2)) if config.auto else dict.fromkeys((*config.edges, *carrying))
    found = tuple(each for kind in kinds for each in drawn(kind, config.names, options.seed, links))
    for each in found:
        if isinstance(each, Kill) and options.virtual and each.service not in VIRTUAL_SERVICES:
            raise ConfigError(f"{each}: under virtual time {' and '.join(VIRTUAL_SERVICES)} alone can be ended")
    return found


def _apps(app: loader.LoadedApp | None, options: Options) -> tuple[loader.LoadedApp, ...]:
    """Return the app that the run is about, and those beside it. Raises `ConfigError` for a parameter of another
    app."""
    apps = () if app is None else (app, *map(loader.load, options.beside))
    names = [each.name for each in apps]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{twice[0]} is there twice: a robot runs an app once")
    for name, setting in options.settings:
        if name and name not in names:
            raise ConfigError(f"--set {name}/{setting.text}: the apps are {', '.join(names)}")
    return apps


def _study(config: Config, options: Options, iterations: int | None, run_dir: Path) -> dict[str, ThesisRecording]:
    """Return the measurements of a simulation study, by robot. If there is a run directory, they are also files in it,
    from which they are replayed."""
    assert options.noise is not None
    rule = options.run_options.rule
    seconds = options.seconds or (rule.seconds if rule is not None else None)
    rows = iterations or math.ceil((seconds or 0.0) / SHORTEST_ITERATION)
    places = {name: config.simulation.places[name][:2] for name in config.names}
    numbers = random.Random(f"{options.seed} noise")
    made = noise.noisy_recordings(options.noise, places, config.simulation.target, rows, numbers)
    if run_dir.is_dir():
        (run_dir / NOISE).mkdir()
        for index, recording in enumerate(made.values()):
            (run_dir / NOISE / f"{index}.csv").write_text(noise.as_csv(recording))
    return made


def _check_end(config: Config, app: loader.LoadedApp, options: Options) -> None:
    """Raise `ConfigError` for an end that the app never comes to."""
    kind = app.kind_on(config, config.names[0])
    if issubclass(kind, EventApp) and options.run_options.rule is not None:
        raise ConfigError(f"--until and --for are for apps in lockstep, which {app.name} is not: use --seconds")
    if options.iterations is not None and _reacts_only(kind):
        raise ConfigError(f"--iterations: {app.name} has none, it reacts to events: use --seconds")


def _check_measured(config: Config, apps: Sequence[loader.LoadedApp], options: Options) -> None:
    """Raise `ConfigError` if measurements are given and no app takes any. With real processes event apps hear them from
    the dwm service, too."""
    if options.noise is None and options.replay is None:
        return
    kinds = [each.kind_on(config, robot) for each in apps for robot in config.names]
    hears = EventApp if not options.virtual else ()
    if not any(issubclass(kind, hears) or getattr(kind, "measured", False) for kind in kinds):
        name = "--replay" if options.noise is None else "--noise"
        raise ConfigError(f"{name}: {apps[0].name} takes no measurements: its class has no `measured = True`")


def _reacts_only(kind: type[BaseApp]) -> bool:
    return issubclass(kind, EventApp) and not issubclass(kind, PeriodicApp)


def _program(app: loader.LoadedApp) -> str:
    return app.name if app.is_built_in else app.source


def _default(options: Options, recorded: int) -> Config:
    count = options.robots or recorded or 3
    names = [f"r{index}" for index in range(count)]
    if options.topology == AUTO:
        return replace(on_table("sim", names, ()), auto=True)
    return on_table("sim", names, _edges(options.topology or "line", names))


def on_table(network: str, names: Sequence[str], edges: tuple[Edge, ...]) -> Config:
    """Return the configuration of a swarm on the thesis' table, with its anchors, its target and its calibrations."""
    return Config(
        path=Path("swarm.toml"),
        network=network,
        robots=tuple(RobotConfig(name) for name in names),
        edges=edges,
        relay=DEFAULT_RELAY,
        anchors=ANCHORS,
        mesh=MeshConfig(insecure=True),
        dwm=Dwm(target=TARGET, window=WINDOW, distance=DISTANCE, position=POSITION),
    )


def _edges(topology: str, names: list[str]) -> tuple[tuple[str, str], ...]:
    if not Path(topology).is_file():
        try:
            return Graph.of_shape(topology, names).edges
        except LocalError as error:
            raise ConfigError(
                f"--topology {topology}: {error}; auto, or the path of a file with a matrix, would do, too"
            ) from None
    rows = [line.replace(",", " ").split() for line in Path(topology).read_text().splitlines() if line.strip()]
    try:
        graph = Graph.of_matrix([[float(cell) for cell in row] for row in rows], names)
        graph.check_connected()
    except (ValueError, LocalError) as error:
        raise ConfigError(f"--topology {topology}: {error}") from None
    return graph.edges


def _dwm(base: Config, replay: Path | None, run_dir: Path) -> Dwm:
    dwm = base.dwm
    if dwm.calibration is not None:  # the run has its configuration elsewhere
        dwm = replace(dwm, calibration=str((base.path.parent / dwm.calibration).absolute()))
    if replay is not None:
        return replace(dwm, source=f"replay:{replay.resolve()}")
    if dwm.source == SOURCE or dwm.source.startswith("bus:"):
        return replace(dwm, target=dwm.target or TARGET)
    return replace(dwm, source=f"serial:{run_dir}/{{robot}}/dwm.tty", target=dwm.target or TARGET)


def _places(config: Config) -> SimulationConfig:
    """Give a place to each robot for which the configuration has none."""
    places = dict(config.simulation.places)
    for index, name in enumerate(config.names):
        if name not in places:
            places[name] = (*first_place(index), 0.0)
    return replace(config.simulation, places=places)


def first_place(index: int) -> tuple[float, float]:
    """Return the place, m, of a robot for which nobody gives one: on the table, then on rings that are half a metre
    apart."""
    if index < len(PLACES):
        return PLACES[index]
    ring, step = divmod(index - len(PLACES), 12)
    angle, radius = 2 * math.pi * (step + 0.5 * (ring % 2)) / 12, 1.4 + 0.5 * ring
    return (1.0 + radius * math.cos(angle), 1.0 + radius * math.sin(angle))


def _parameters(config: Config, wanted: loader.LoadedApp, options: Options, *, first: bool) -> AppConfig:
    """Return the app's parameters: the file's, then the thesis' starting values, then those of the command line.
    `first`: options that name no app mean this one."""
    app = config.app(wanted.name)
    common: dict[str, Value] = dict(app.parameters)
    robots: dict[str, dict[str, Value]] = {robot: dict(values) for robot, values in app.robots.items()}
    if options.algorithm is not None and first:
        common["algorithm"] = options.algorithm
    if options.step_size is not None and first:
        common["step_size"] = options.step_size * 1e4  # 1/cm^2 in 1/m^2
    if wanted.name == "consensus" and wanted.is_built_in and "value" not in common:
        starts = START_VALUES.get(len(config.names), tuple(float(index) for index in range(len(config.names))))
        for robot, value in zip(config.names, starts, strict=True):
            robots.setdefault(robot, {}).setdefault("value", value)
    settings = [it for app, it in options.settings if app == wanted.name or (first and not app)]
    return on_top(AppConfig(common, robots), settings, config.names)
