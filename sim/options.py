"""Arguments of `swarm sim`, checked before anything starts."""

import argparse
from pathlib import Path

from sim.core.noise import ERRORS
from sim.quantities import (
    AppSetting,
    Cut,
    Off,
    ScheduledPress,
    at_least,
    cut,
    duration,
    loss,
    off,
    positive,
    press,
    rate,
    setting,
    skew,
    speed,
    velocity,
)
from sim.virtual.body import MODELS
from swarm.app import run_options
from swarm.app.run_options import RunOptions
from swarm.errors import ConfigError
from swarm.frozen import frozen

FROM_START, SETTLED, DELAY = "start", "settled", "delay"
MESHES = (FROM_START, SETTLED, DELAY)
"""Under virtual time: real mesh cores from power-on; such that know all links already; the delay of links alone."""

PRESS_S = 0.3
"""How long a button is held down."""


@frozen
class Options:
    """What `swarm sim` was asked for. Lengths in m, times in s, rates in bytes/s."""

    app: str | None
    """What the run is about."""
    beside: tuple[str, ...]
    """Other apps that each robot runs meanwhile."""
    robots: int | None
    topology: str | None
    config: Path | None
    algorithm: str | None
    settings: tuple[AppSetting, ...]
    step_size: float | None
    """The thesis' unit, 1/cm^2."""
    latency: float
    jitter: float
    bandwidth: float | None
    loss: float
    """Probability that a radio packet is lost and sent again."""
    clock_skew: float
    """How far the rates of the robots' clocks err at most, 1e-6 = 1 ppm; 0: all have one clock."""
    cuts: tuple[Cut, ...]
    offs: tuple[Off, ...]
    presses: tuple[ScheduledPress, ...]
    lying: str | None
    """front or back: how robots lie at the start; None: as the app wants it."""
    seconds: float | None
    iterations: int | None
    seed: int
    replay: Path | None
    noise: str | None
    """Of `core.noise.ERRORS`: how measurements err; None: as the simulated modules do."""
    target_velocity: tuple[float, float] | None
    """m/s; None: as the configuration says."""
    json: bool
    plot: Path | None
    run_dir: Path | None
    record: Path | None
    """Where the trajectories are kept; without it they go with the run."""
    run_options: RunOptions
    """When its lockstep ends but for `iterations`, and what becomes of robots that stay away."""
    demo: bool
    virtual: bool
    """In one process under a virtual clock."""
    body: str
    """Model of the bodies then."""
    mesh: str | None
    """How much of the mesh there is then; None: by the size of the swarm."""
    view: bool
    """Show it in the browser while it runs."""
    speed: float | None
    """s of virtual time a second then; infinity: as fast as it computes; None: as the real time."""
    no_open: bool
    """Only print the page's address."""


def parser() -> argparse.ArgumentParser:
    """The argument parser of `swarm sim`."""
    p = argparse.ArgumentParser(
        prog="swarm sim",
        description="Run a simulated swarm: for each robot the processes that run on a Pi, in one simulated world.",
        epilog="Watch it from another terminal: z_sub 'swarm/**'. End one of its services: swarm hand kill r0 mesh. "
        "Lay hands on a robot: swarm hand push r0, swarm hand lay r1 back, swarm hand press r2 A.",
    )
    p.add_argument(
        "apps",
        nargs="*",
        metavar="APP",
        help="consensus, localization or a file with an app; none: just balance. Each robot runs further ones beside "
        "the first, which the run is about",
    )
    swarm = p.add_argument_group("the swarm")
    swarm.add_argument("--robots", type=at_least(1), metavar="N", help="number of robots (3, or as the replay has)")
    swarm.add_argument(
        "--topology", metavar="NAME|FILE", help="line, loop, full, thesis-d, random:SEED, auto, or a matrix file"
    )
    swarm.add_argument("--config", type=Path, metavar="FILE", help="take the swarm from this swarm.toml instead")
    app = p.add_argument_group("the app")
    app.add_argument("--algorithm", metavar="NAME", help="which algorithm of the app")
    app.add_argument("--set", dest="settings", action="append", type=setting, default=[],
                     metavar="[APP/][ROBOT.]NAME=VALUE",
                     help="a parameter of the first app or of the one named, for all robots or for one")  # fmt: skip
    app.add_argument("--step-size", type=positive, metavar="G", help="gradient step in the thesis' unit, 1/cm^2")
    app.add_argument(
        "--replay", type=Path, metavar="DIR", help="feed the measurements recorded in DIR (k.csv for robot k)"
    )
    app.add_argument(
        "--noise",
        choices=list(ERRORS),
        metavar="MODEL",
        help="measurements of a simulation study: none, bias (5 %%), thesis (5 %% and 2 %% every 5 iterations)",
    )
    app.add_argument("--target-velocity", type=velocity, metavar="VX,VY",
                     help="the target moves, m/s, from the first iteration of all robots on")  # fmt: skip
    radio = p.add_argument_group("the radio")
    radio.add_argument("--latency", type=duration, default=0.03, metavar="30ms", help="one way (30ms)")
    radio.add_argument(
        "--jitter", type=duration, default=0.0, metavar="10ms", help="standard deviation of the latency (0)"
    )
    radio.add_argument("--bandwidth", type=rate, metavar="78kB", help="per second and direction (no limit)")
    radio.add_argument(
        "--loss", type=loss, default=0.0, metavar="0.05", help="radio packets that are lost, and sent again (0)"
    )
    radio.add_argument("--cut", dest="cuts", action="append", type=cut, default=[], metavar="r0-r1@12s,3s",
                       help="cut a link 12 s after the first iteration for 3 s")  # fmt: skip
    radio.add_argument("--off", dest="offs", action="append", type=off, default=[], metavar="r2@5s,10s",
                       help="under virtual time: switch a robot off 5 s after the first iteration for 10 s; "
                       "@start: it comes late")  # fmt: skip
    bodies = p.add_argument_group("the bodies")
    bodies.add_argument("--clock-skew", type=skew, default=0.0, metavar="20ppm",
                        help="under virtual time: each robot's clock has a zero of its own, and a rate that errs by "
                        "up to this (0: all have one clock)")  # fmt: skip
    bodies.add_argument("--press", dest="presses", action="append", type=press, default=[], metavar="r4.A@5s",
                        help="press a button 5 s after the first iteration")  # fmt: skip
    bodies.add_argument(
        "--lying", choices=("front", "back"), help="robots lie on this side at the start and wait for an order"
    )
    run = p.add_argument_group("the run")
    end = run.add_mutually_exclusive_group()
    end.add_argument("--seconds", type=duration, metavar="S", help="end after this time")
    end.add_argument(
        "--iterations",
        type=at_least(1),
        metavar="K",
        help="end after K iterations (100, or all of a replay)",
    )
    run.add_argument(
        "--seed", type=at_least(0), default=1, metavar="S", help="of noise, jitter and random topologies (1)"
    )
    run_options.add_arguments(p)
    run.add_argument("--json", action="store_true", help="one JSON object as the last line of the output")
    run.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the run")
    run.add_argument("--record", type=Path, metavar="DIR", help="keep the recording of the run in this folder")
    run.add_argument("--run-dir", type=Path, metavar="DIR", help="where sockets and logs live while it runs")
    p.add_argument("--virtual", action="store_true",
                   help="in one process under a virtual clock: reproducible, and as fast as it computes")  # fmt: skip
    p.add_argument("--body", choices=MODELS, default=MODELS[0],
                   help="how bodies move under virtual time: with ramps and errors, or as they are told")  # fmt: skip
    p.add_argument("--mesh", choices=MESHES,
                   help="under virtual time the whole mesh from its start, or settled (above 50 robots), "
                   "or its delays alone")  # fmt: skip
    p.add_argument(
        "--view", action="store_true", help="under virtual time: show the run in the browser, as swarm view does"
    )
    p.add_argument("--speed", type=speed, metavar="X|max",
                   help="with --view: X s of the robots' time a second (1), or as fast as it computes")  # fmt: skip
    p.add_argument("--no-open", action="store_true", help="with --view: only print the page's address")
    p.add_argument("--demo", action="store_true", help=argparse.SUPPRESS)
    return p


def parse(arguments: list[str]) -> Options:
    """Read the command line; argparse ends the process with code 2 and a message where it is wrong."""
    read = _tuples(parser().parse_intermixed_args(arguments))
    options = Options(run_options=run_options.of(read), **vars(read))
    if options.config is not None and (options.robots is not None or options.topology is not None):
        raise ConfigError("--config names robots and topology itself: leave out --robots and --topology")
    if options.noise is not None and options.replay is not None:
        raise ConfigError("--noise makes the measurements, --replay has recorded ones: leave out one of them")
    if options.target_velocity is not None and (options.noise is not None or options.replay is not None):
        raise ConfigError("--target-velocity moves what simulated modules range to: leave out --noise and --replay")
    if options.target_velocity is not None and options.clock_skew:
        raise ConfigError("--target-velocity and --clock-skew: each robot would have another time, leave out one")
    if options.clock_skew and not options.virtual:
        raise ConfigError("--clock-skew is for --virtual: processes of one machine have one clock")
    if options.offs and not options.virtual:
        raise ConfigError("--off is for --virtual; of real processes: swarm hand kill r2 app, swarm hand kill r2 mesh")
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
            (options.plot, "--plot"),
        ):
            if given:
                raise ConfigError(f"{name} needs an APP, e.g. swarm sim consensus")
        if options.iterations is not None:
            raise ConfigError("--iterations needs an APP; without one use --seconds")
        if options.run_options.arguments:
            raise ConfigError("--until, --for and --absent need an APP, e.g. swarm sim consensus")
    return options


def _tuples(namespace: argparse.Namespace) -> argparse.Namespace:
    apps = vars(namespace).pop("apps")
    namespace.app, namespace.beside = (apps[0] if apps else None), tuple(apps[1:])
    for name in ("settings", "cuts", "offs", "presses"):
        setattr(namespace, name, tuple(getattr(namespace, name)))
    return namespace
