"""Arguments of `swarm sim`, checked before anything starts."""

import argparse
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from services.mesh.core.delay import MAX_LOSS
from services.sim.core.noise import ERRORS
from services.sim.virtual.body import MODELS
from swarm import conduct, settings
from swarm.conduct import Conduct
from swarm.errors import AppError, ConfigError
from swarm.settings import Setting

_DURATION = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "": 1.0}
_SIZE = {"B": 1.0, "kB": 1e3, "MB": 1e6, "": 1.0}
_NUMBER = re.compile(r"([0-9.]+(?:e[+-]?[0-9]+)?) *([a-zA-Z%]*)")


@dataclass(frozen=True)
class Cut:
    """A link that passes nothing for a while."""

    a: str
    b: str
    at: float
    """s after the first iteration of all robots (without an app: after all are ready)."""
    seconds: float


FROM_START, SETTLED, DELAY = "start", "settled", "delay"
MESHES = (FROM_START, SETTLED, DELAY)
"""Under virtual time: real mesh cores from power-on; such that know all links already; the delay of links alone."""


@dataclass(frozen=True)
class Off:
    """A robot that is switched off for a while, and forgets what it knew but for its votes."""

    robot: str
    at: float | None
    """s, counted like a cut's; None: from the beginning."""
    seconds: float


SLOWEST, FASTEST = 0.01, 1000.0
"""s of virtual time a second that a page may wish for."""

MAX_SKEW = 100e-6
"""More than a crystal errs, and what the mesh clock is made for."""

PRESS_S = 0.3
"""How long a button is held down."""


@dataclass(frozen=True)
class Press:
    """A button that somebody presses."""

    robot: str
    button: str
    at: float
    """s, counted like a cut's."""


@dataclass(frozen=True)
class Options:
    """What `swarm sim` was asked for. Lengths in m, times in s, rates in bytes/s."""

    app: str | None
    robots: int | None
    topology: str | None
    config: Path | None
    algorithm: str | None
    settings: tuple[Setting, ...]
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
    presses: tuple[Press, ...]
    lying: str | None
    """front or back: how robots lie at the start; None: as the app wants it."""
    seconds: float | None
    iterations: int | None
    seed: int
    replay: Path | None
    noise: str | None
    """Of `core.noise.ERRORS`: how measurements err; None: as the simulated modules do."""
    json: bool
    plot: Path | None
    run_dir: Path | None
    record: Path | None
    """Where the trajectories are kept; without it they go with the run."""
    conduct: Conduct
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


def _quantity(text: str, units: dict[str, float], what: str) -> float:
    match = _NUMBER.fullmatch(text.strip())
    if match is None or match[2] not in units:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    try:
        return float(match[1]) * units[match[2]]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}") from None


def duration(text: str) -> float:
    """Seconds of `30ms`, `3s`, `2min` or a bare number of seconds."""
    return _quantity(text, _DURATION, "a time such as 30ms or 3s")


def rate(text: str) -> float:
    """Bytes per second of `78kB`, `1MB` or a bare number of bytes."""
    value = _quantity(text, _SIZE, "a rate such as 78kB (per second)")
    if value <= 0:
        raise argparse.ArgumentTypeError("a bandwidth must be above zero")
    return value


def cut(text: str) -> Cut:
    """A cut `r0-r1@12s,3s`: which link, when, how long."""
    match = re.fullmatch(r"([a-z][a-z0-9_]*)-([a-z][a-z0-9_]*)@([^,]+),(.+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a cut such as r0-r1@12s,3s (link, start, length)")
    return Cut(match[1], match[2], duration(match[3]), duration(match[4]))


def off(text: str) -> Off:
    """A robot `r2@5s,10s` that is switched off: which, when, how long; `r2@start,10s` comes late."""
    match = re.fullmatch(r"([a-z][a-z0-9_-]*)@([^,]+),(.+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a robot such as r2@5s,10s (which, from when, how long)")
    at = None if match[2] == FROM_START else duration(match[2])
    seconds = duration(match[3])
    if not seconds > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time above zero")
    return Off(match[1], at, seconds)


def press(text: str) -> Press:
    """A button `r4.A@5s`: whose, which, when."""
    match = re.fullmatch(r"([a-z][a-z0-9_-]*)\.([ABCabc])@(.+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a button such as r4.A@5s (robot, button, time)")
    return Press(match[1], match[2].upper(), duration(match[3]))


def setting(text: str) -> Setting:
    """A parameter `value=0.5` or, of one robot, `r2.value=3`."""
    try:
        return settings.parse(text)
    except AppError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _at_least(low: int) -> Callable[[str], int]:
    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
        if value < low:
            raise argparse.ArgumentTypeError(f"must be at least {low}")
        return value

    return convert


def speed(text: str) -> float:
    """`0.5`, or `max`: infinity."""
    if text == "max":
        return math.inf
    value = _quantity(text, {"": 1.0}, "a speed such as 0.5, or max")
    if not SLOWEST <= value <= FASTEST:
        raise argparse.ArgumentTypeError(f"expected {SLOWEST:g} to {FASTEST:g}, or max")
    return value


def loss(text: str) -> float:
    """A probability `5%` or `0.05`."""
    value = _quantity(text, {"": 1.0, "%": 0.01}, "a probability such as 5% or 0.05")
    if not value <= MAX_LOSS:
        raise argparse.ArgumentTypeError(f"{text!r}: expected at most {100 * MAX_LOSS:g}%")
    return value


def skew(text: str) -> float:
    """An error of clocks, `20ppm`."""
    value = _quantity(text, {"ppm": 1e-6}, "an error such as 20ppm")
    if not value <= MAX_SKEW:
        raise argparse.ArgumentTypeError(f"{text!r}: expected at most {1e6 * MAX_SKEW:g}ppm")
    return value


def _positive(text: str) -> float:
    value = _quantity(text, {"": 1.0}, "a number")
    if value <= 0:
        raise argparse.ArgumentTypeError("must be above zero")
    return value


def parser() -> argparse.ArgumentParser:
    """The argument parser of `swarm sim`."""
    p = argparse.ArgumentParser(
        prog="swarm sim",
        description="Run a simulated swarm: for each robot the processes that run on a Pi, in one simulated world.",
        epilog="Watch it from another terminal: z_sub 'swarm/**'. End one of its services: swarm kill r0 mesh. "
        "Lay hands on a robot: swarm push r0, swarm lay r1 back, swarm press r2 A.",
    )
    p.add_argument(
        "app",
        nargs="?",
        metavar="APP",
        help="consensus, localization or a file with an app; none: just balance",
    )
    swarm = p.add_argument_group("the swarm")
    swarm.add_argument("--robots", type=_at_least(1), metavar="N", help="number of robots (3, or as the replay has)")
    swarm.add_argument(
        "--topology", metavar="NAME|FILE", help="line, loop, full, thesis-d, random:SEED, auto, or a matrix file"
    )
    swarm.add_argument("--config", type=Path, metavar="FILE", help="take the swarm from this swarm.toml instead")
    app = p.add_argument_group("the app")
    app.add_argument("--algorithm", metavar="NAME", help="which algorithm of the app")
    app.add_argument("--set", dest="settings", action="append", type=setting, default=[], metavar="[ROBOT.]NAME=VALUE",
                     help="a parameter of the app, for all robots or for one")  # fmt: skip
    app.add_argument("--step-size", type=_positive, metavar="G", help="gradient step in the thesis' unit, 1/cm^2")
    app.add_argument(
        "--replay", type=Path, metavar="DIR", help="feed the measurements recorded in DIR (k.csv for robot k)"
    )
    app.add_argument(
        "--noise",
        choices=list(ERRORS),
        metavar="MODEL",
        help="measurements of a simulation study: none, bias (5 %%), thesis (5 %% and 2 %% every 5 iterations)",
    )
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
        type=_at_least(1),
        metavar="K",
        help="end after K iterations (100, or all of a replay)",
    )
    run.add_argument(
        "--seed", type=_at_least(0), default=1, metavar="S", help="of noise, jitter and random topologies (1)"
    )
    conduct.add_arguments(p)
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
    read = _tuples(parser().parse_args(arguments))
    options = Options(conduct=conduct.of(read), **vars(read))
    if options.config is not None and (options.robots is not None or options.topology is not None):
        raise ConfigError("--config names robots and topology itself: leave out --robots and --topology")
    if options.noise is not None and options.replay is not None:
        raise ConfigError("--noise makes the measurements, --replay has recorded ones: leave out one of them")
    if options.clock_skew and not options.virtual:
        raise ConfigError("--clock-skew is for --virtual: processes of one machine have one clock")
    if options.offs and not options.virtual:
        raise ConfigError("--off is for --virtual; of real processes: swarm kill r2 app, swarm kill r2 mesh")
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
        if options.conduct.words:
            raise ConfigError("--until, --for and --absent need an APP, e.g. swarm sim consensus")
        if options.iterations is not None:
            raise ConfigError("--iterations needs an APP; without one use --seconds")
    return options


def _tuples(namespace: argparse.Namespace) -> argparse.Namespace:
    for name in ("settings", "cuts", "offs", "presses"):
        setattr(namespace, name, tuple(getattr(namespace, name)))
    return namespace
