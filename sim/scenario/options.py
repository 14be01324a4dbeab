"""Arguments of `swarm sim`, checked before anything starts."""

import argparse
from pathlib import Path
from typing import NoReturn

from services.apps.loader import BUILT_IN
from sim.core.noise import ERRORS
from sim.disturbances import (
    KILLABLE,
    Cut,
    Kill,
    Off,
    ScheduledPress,
    ScheduledPush,
    parsed_cut,
    parsed_kill,
    parsed_off,
    parsed_press,
    parsed_push,
)
from sim.scenario import commission_report
from sim.scenario.builtin_apps import BY_NAME, USUAL
from sim.scenario.quantities import (
    AppSetting,
    add_app_settings,
    duration,
    loss,
    negative_joined,
    rate,
    run_length,
    skew,
    slots,
    speed,
    velocity,
)
from sim.slots.parameters import SlotParameters
from sim.virtual.robot.body import MODELS
from swarm.app import run_options
from swarm.app.run_options import RunOptions
from swarm.config.types import LINKS
from swarm.errors import ConfigError
from swarm.frozen import frozen
from swarm.process.arguments import HintingParser, picture_name, whole

FROM_START, SETTLED, DELAY = "start", "settled", "delay"
MESHES = (FROM_START, SETTLED, DELAY)
"""Models of the mesh under virtual time: the mesh's own code from power-on; the same code, which knows all links
already; or no mesh, so that messages reach neighbours alone, after the latency of the link."""

EVENTS = ("cut", "kill", "off", "press", "push")
"""Options that say what happens to a link or a robot at a time of the run."""

LATENCY = 0.03
"""Latency of links of which nothing else is known, one way, s."""

MOST_ROBOTS, MOST_VIRTUAL = 100, 100_000
"""Robots of a simulation at most: with real processes, of which each robot has five, and under virtual time."""

PRESS_S = 0.3
"""Seconds for which a button is held down."""


@frozen
class Options:
    """The options of `swarm sim`. Lengths in m, times in s, rates in bytes/s."""

    app: str | None
    """Name or file of the app that the run is about."""
    beside: tuple[str, ...]
    """Other apps that each robot runs meanwhile."""
    robots: int | None
    topology: str | None
    links: str | None
    """The way in which links carry the topology; None: as the configuration says."""
    config: Path | None
    algorithm: str | None
    settings: tuple[AppSetting, ...]
    step_size: float | None
    """Step size in the thesis' unit, 1/cm^2."""
    like: commission_report.MeasuredRobot | None
    """Measurements of a real robot, which hold for all simulated ones."""
    latency: float
    jitter: float
    bandwidth: float | None
    loss: float
    """Probability that a radio packet is lost and sent again."""
    slots: SlotParameters | None
    """The slot radio; None: all links have the delays above."""
    clock_skew: float
    """Largest rate error of the robots' clocks, 1e-6 = 1 ppm; 0: all have one clock."""
    cuts: tuple[Cut, ...]
    offs: tuple[Off, ...]
    kills: tuple[Kill, ...]
    pushes: tuple[ScheduledPush, ...]
    presses: tuple[ScheduledPress, ...]
    """In these and in the other disturbances the seed may still draw robots and times; a `Scenario` has them drawn."""
    lying: str | None
    """front or back: how robots lie at the start; None: as the app wants it."""
    seconds: float | None
    iterations: int | None
    seed: int
    replay: Path | None
    noise: str | None
    """The name in `core.noise.ERRORS` of the measurements' errors; None: those of the simulated modules."""
    target_velocity: tuple[float, float] | None
    """m/s; None: as the configuration says."""
    json: bool
    plot: Path | None
    run_dir: Path | None
    record: Path | None
    """Folder in which the trajectories are kept; without it they go with the run."""
    run_options: RunOptions
    """Rules for the end of its lockstep, besides `iterations`, and for robots that stay away."""
    virtual: bool
    """Whether the run is in one process under a virtual clock."""
    body: str
    """Model of the bodies under virtual time."""
    mesh: str | None
    """Mesh model under virtual time; None: chosen by `sim.virtual.mesh_choice`."""
    view: bool
    """Whether the browser shows the run."""
    speed: float | None
    """Seconds of virtual time a second of a run in the browser; infinity: as fast as it computes; None: as real
    time."""
    no_open: bool
    """Whether the page's address is only printed."""


def parser(kind: type[argparse.ArgumentParser] = HintingParser) -> argparse.ArgumentParser:
    """Return the argument parser of `swarm sim`."""
    p = kind(
        prog="swarm sim",
        description="Run a simulated swarm: for each robot the processes that run on a Pi, in one simulated world.",
        epilog="Watch it from another terminal: z_sub 'swarm/**'. End one of its services: swarm hand kill r0 mesh. "
        "Act on a robot: swarm hand push r0, swarm hand lay r1 back, swarm hand press r2 A.",
    )
    p.add_argument(
        "apps",
        nargs="*",
        metavar="APP",
        help=f"{', '.join(BUILT_IN)}, or a file with an app; without an app robots only balance. Each robot runs all "
        "apps; the first one ends the run",
    )
    swarm = p.add_argument_group("the swarm")
    swarm.add_argument(
        "--robots", type=whole(1, MOST_VIRTUAL), metavar="N", help="number of robots (3, or as in the replay)"
    )
    swarm.add_argument(
        "--topology",
        metavar="NAME|FILE",
        help="line, loop, full, thesis-d, random:SEED, auto, or a file with a matrix of 0 and 1",
    )
    swarm.add_argument(
        "--links",
        choices=LINKS,
        help="which links carry the topology: its own (graph), those of one "
        "hub (star) or of several (tree), or what suits the radio (auto)",
    )
    swarm.add_argument("--config", type=Path, metavar="FILE", help="take the swarm from this swarm.toml instead")
    swarm.add_argument(
        "--like",
        type=Path,
        metavar="REPORT",
        help="use the I2C clock, latency, trim, battery and noise that swarm commission has measured",
    )
    app = p.add_argument_group("the app")
    add_app_settings(app)
    app.add_argument(
        "--replay", type=Path, metavar="DIR", help="feed the measurements recorded in DIR (k.csv for robot k)"
    )
    app.add_argument(
        "--noise",
        choices=list(ERRORS),
        metavar="MODEL",
        help="measurements of a simulation study: none, bias (5 %%), thesis (5 %% and 2 %% every 5 iterations)",
    )
    app.add_argument(
        "--target-velocity",
        type=velocity,
        metavar="VX,VY",
        help="velocity of the target, m/s, from the first iteration of all robots on",
    )
    radio = p.add_argument_group("the radio")
    radio.add_argument(
        "--latency", type=duration, metavar="30ms", help="latency in one direction (30ms, or as in --like)"
    )
    radio.add_argument(
        "--jitter", type=duration, default=0.0, metavar="10ms", help="standard deviation of the latency (0)"
    )
    radio.add_argument("--bandwidth", type=rate, metavar="78kB", help="bandwidth per second and direction (no limit)")
    radio.add_argument(
        "--loss", type=loss, default=0.0, metavar="0.05", help="share of radio packets that are lost and sent again (0)"
    )
    radio.add_argument(
        "--radio",
        dest="slots",
        type=slots,
        metavar="slots[:NAME=X,...]",
        help="a Bluetooth radio with piconets, bridges and pages in place of one delay for all links; "
        "slots:stay=0.2 changes a parameter",
    )
    radio.add_argument(
        "--cut",
        dest="cuts",
        action="append",
        type=parsed_cut,
        default=[],
        metavar="r0-r1@12s,3s",
        help="cut a link 12 s after the first iteration for 3 s",
    )
    radio.add_argument(
        "--off",
        dest="offs",
        action="append",
        type=parsed_off,
        default=[],
        metavar="r2@5s,10s",
        help="switch a robot off 5 s after the first iteration for 10 s; @start: it comes late; "
        "any@2s..8s,10s: the seed draws robot and time, also for the other faults",
    )
    radio.add_argument(
        "--kill",
        dest="kills",
        action="append",
        type=parsed_kill,
        default=[],
        metavar="r2.app@5s",
        help=f"end a service, which then restarts: {', '.join(KILLABLE)} (under virtual time: app, mesh)",
    )
    bodies = p.add_argument_group("the bodies")
    bodies.add_argument(
        "--clock-skew",
        type=skew,
        metavar="20ppm",
        help="under virtual time: each robot's clock has its own zero, and a rate error of "
        "up to this (0, all have one clock; with led_sync 20ppm)",
    )
    bodies.add_argument(
        "--press",
        dest="presses",
        action="append",
        type=parsed_press,
        default=[],
        metavar="r4.A@5s",
        help="press a button 5 s after the first iteration",
    )
    bodies.add_argument(
        "--push",
        dest="pushes",
        action="append",
        type=parsed_push,
        default=[],
        metavar="r1@5s,0.2",
        help="push a robot from behind 5 s after the first iteration, in N s (0.1; 0.5 topples it)",
    )
    bodies.add_argument(
        "--lying", choices=("front", "back"), help="robots lie on this side at the start and wait for a command"
    )
    run = p.add_argument_group("the run")
    end = run.add_mutually_exclusive_group()
    end.add_argument("--seconds", type=run_length, metavar="S", help="end after this time")
    end.add_argument(
        "--iterations", type=whole(1), metavar="K", help="last iteration (100; with --until 10000; all of a replay)"
    )
    run.add_argument(
        "--seed", type=whole(0), default=1, metavar="S", help="seed of noise, jitter and random topologies (1)"
    )
    run_options.add_arguments(p)
    run.add_argument("--json", action="store_true", help="print one JSON object")
    run.add_argument("--plot", type=picture_name, metavar="FILE.png", help="draw the run")
    run.add_argument("--record", type=Path, metavar="DIR", help="write the recording of the run to this folder")
    run.add_argument("--run-dir", type=Path, metavar="DIR", help="directory for sockets and logs during the run")
    p.add_argument(
        "--virtual",
        action="store_true",
        help="use one process and a virtual clock: reproducible, and as fast as possible",
    )
    p.add_argument(
        "--body",
        choices=MODELS,
        default=MODELS[0],
        help="motion under virtual time: with ramps and errors, or exactly as commanded",
    )
    p.add_argument(
        "--mesh",
        choices=MESHES,
        help="model of the mesh under virtual time: the whole mesh from its start; the settled mesh, which knows all "
        "links already (above 50 robots); or delays in place of a mesh (above 200, if the run needs no more)",
    )
    p.add_argument(
        "--view", action="store_true", help="under virtual time: show the run in the browser, as swarm view does"
    )
    p.add_argument(
        "--speed",
        type=speed,
        metavar="X|max",
        help="with --view: X s of the robots' time a second (1), or as fast as it computes",
    )
    p.add_argument("--no-open", action="store_true", help="with --view: only print the page's address")
    return p


class _Refusing(argparse.ArgumentParser):
    """A parser that raises an error instead of ending the process."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(message.removeprefix("argument "))


def parse(arguments: list[str], *, ends: bool = True) -> Options:
    """Read the command line; where it is wrong, argparse ends the process with code 2 and a message, or with `ends`
    false `ConfigError` is raised."""
    reader = parser(HintingParser if ends else _Refusing)
    read = _tuples(reader.parse_intermixed_args(negative_joined(arguments)))
    read.like = None if read.like is None else commission_report.read(read.like)
    if read.latency is None:
        measured = None if read.like is None else read.like.latency
        read.latency = LATENCY if measured is None else measured
    if read.clock_skew is None:
        usual = BY_NAME.get(read.app, USUAL).clock_skew
        read.clock_skew = usual if read.virtual and read.target_velocity is None else 0.0
    options = Options(run_options=run_options.of(read), **vars(read))
    if options.config is not None and (options.robots is not None or options.topology is not None):
        raise ConfigError("--config names robots and topology itself: leave out --robots and --topology")
    folder = None if options.plot is None else options.plot.parent
    # The run makes the folder of its recording itself.
    if folder is not None and not folder.is_dir() and folder != options.record:
        raise ConfigError(f"--plot {options.plot}: there is no folder {folder}")
    if options.noise is not None and options.replay is not None:
        raise ConfigError("--noise makes the measurements, --replay has recorded ones: leave out one of them")
    if options.target_velocity is not None and (options.noise is not None or options.replay is not None):
        raise ConfigError(
            "--target-velocity: --noise and --replay have measurements of a target that stands still: leave them out, "
            "and simulated UWB modules measure the moving one"
        )
    if options.target_velocity is not None and options.clock_skew:
        raise ConfigError("--target-velocity and --clock-skew: each robot would have another time, leave out one")
    if options.clock_skew and not options.virtual:
        raise ConfigError("--clock-skew is for --virtual: processes of one machine have one clock")
    if options.robots is not None and options.robots > MOST_ROBOTS and not options.virtual:
        raise ConfigError(
            f"--robots {options.robots}: more than {MOST_ROBOTS} are for --virtual, which has no processes"
        )
    if (options.mesh is not None or options.body != MODELS[0]) and not options.virtual:
        raise ConfigError(
            "--mesh and --body choose models of --virtual: here are the real mesh, and a body with physics"
        )
    if options.slots is not None and (options.jitter or options.bandwidth or options.loss or options.mesh == DELAY):
        raise ConfigError("--radio slots has times of its own: leave out --jitter, --bandwidth, --loss, --mesh delay")
    if options.view and not options.virtual:
        raise ConfigError("--view shows virtual time; for this one: swarm view, in another terminal")
    if (options.speed is not None or options.no_open) and not options.view:
        raise ConfigError("--speed and --no-open are for --view")
    if options.app is None:
        for given, name in (
            (options.algorithm, "--algorithm"),
            (options.settings, "--set"),
            (options.replay, "--replay"),
            (options.noise, "--noise"),
            (options.offs, "--off"),
            (options.kills, "--kill"),
            (options.plot, "--plot"),
            (options.virtual and options.record, "--record under --virtual"),
        ):
            if given:
                raise ConfigError(f"{name} needs an APP, e.g. swarm sim consensus")
        if options.iterations is not None:
            raise ConfigError("--iterations needs an APP; without one use --seconds")
        if options.virtual and options.seconds is None and not options.view:
            raise ConfigError("--virtual needs an APP, or --seconds: robots without an app would stand there for ever")
        if options.run_options.arguments:
            raise ConfigError("--until, --for and --absent need an APP, e.g. swarm sim consensus")
    return options


def _tuples(namespace: argparse.Namespace) -> argparse.Namespace:
    apps = vars(namespace).pop("apps")
    namespace.app, namespace.beside = (apps[0] if apps else None), tuple(apps[1:])
    for name in ("settings", "cuts", "offs", "kills", "pushes", "presses"):
        setattr(namespace, name, tuple(getattr(namespace, name)))
    return namespace
