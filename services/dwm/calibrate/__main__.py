"""`swarm calibrate`: a guided calibration of a robot's UWB module, a check of one, a fit of recorded samples."""

import argparse
import os
import sys
from datetime import UTC, datetime
from pathlib import Path

from services.dwm.calibrate import making, plots
from services.dwm.calibrate.making import CalibrationData, LearnedOffset
from services.dwm.calibrate.session import Hearing, hold
from services.dwm.core.calibration import calibration_file, fitting, limits, samples
from services.dwm.core.calibration.guide import QUARTERS, SAMPLES, Guide, grid
from services.dwm.core.calibration.samples import Point3, RangeSample, groups, of_recording
from services.dwm.core.estimation.filters import Place
from services.dwm.localizer import calibration_path, load_calibration, uncalibrated
from swarm import clock
from swarm import config as configuration
from swarm.bus.zenoh_bus import Bus
from swarm.config import Config
from swarm.errors import BusError, LocalError
from swarm.files import atomic_write, make_folder
from swarm.onboard.buses import buses
from swarm.onboard.command_line import add_verb
from swarm.process import log, service
from swarm.process.arguments import CommandParser, number, whole
from swarm.process.simulations import CONFIG, default_run_dir, is_live
from swarm.recording.thesis_ranges import read_recording

DESCRIPTION = "Calibrate the UWB module of a robot, check a calibration, or fit one to recorded samples."

EPILOG = """\
distance and position lead you through a session: put the robot at the named place and orientation (0 degrees = along
x, 90 = along y), press button A or the space bar, and go on to the next. A script may pipe in the lines start, next,
redo and quit.
"""


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 = done, and for `check` that the calibration still holds."""
    log.setup("calibrate")
    options = options_of(sys.argv[1:] if argv is None else argv)
    config = _config(options)
    (robot,) = options.robots
    if robot not in config.names:
        raise LocalError(f"no robot {robot!r} in {config.path}, there are {', '.join(config.names)}")
    try:
        code: int = options.run(options, config, robot)
        sys.stdout.flush()
    except BrokenPipeError:  # `| head` is no fault
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return code


def guided(options: argparse.Namespace, config: Config, robot: str) -> int:
    """`distance` and `position`: a session, a fit, the file."""
    data = CalibrationData.of(_session(options, config, robot, places_of(options, config)), _modules(options, config))
    return _make(options, config, robot, data, (options.command,))


def measure(options: argparse.Namespace, config: Config, robot: str) -> int:
    """`samples`: a session alone. Its file is for a fit elsewhere."""
    _session(options, config, robot, places_of(options, config))
    return 0


def fit(options: argparse.Namespace, config: Config, robot: str) -> int:
    """Fit samples that were recorded before: what they hold of ranges and places."""
    if options.thesis:
        print(making.thesis_text(making.read(options.samples, samples.THESIS_PLACES, None)))
        return 0
    found = _recorded(options, config)
    data = CalibrationData.of(found, _modules(options, config))
    wanted = [name for name, there in (("distance", data.groups), ("position", data.spots)) if there]
    return _make(options, config, robot, data, (options.only,) if options.only else tuple(wanted) or ("distance",))


def check(options: argparse.Namespace, config: Config, robot: str) -> int:
    """Compare fresh samples, or a file of them, with the calibration in use."""
    if problem := uncalibrated(config, robot):
        raise LocalError(problem)
    path = calibration_path(config, robot)
    models = load_calibration(config, robot)
    file = calibration_file.parse(path.read_text("utf-8"), str(path)) if path is not None else None
    if options.samples is not None and options.samples.exists():
        found = _recorded(options, config)
    else:
        found = _session(options, config, robot, places_of(options, config))
    lines, good = making.verdict(models, file, CalibrationData.of(found, _modules(options, config)))
    print("\n".join(lines))
    return 0 if good else 1


def offset(options: argparse.Namespace, config: Config, robot: str) -> int:
    """Take over by how much a robot's ranges are too long: from its commissioning, or a run at a known place."""
    if not options.recording.exists():
        raise LocalError(f"{options.recording}: there is no such report of swarm commission, and no such folder")
    learned = _commissioned(options, robot) if options.recording.is_file() else _of_run(options, config, robot)
    limits.check_offset(learned.offset)
    path = calibration_path(config, robot)
    if options.write:
        if path is None:
            raise LocalError('there is no place for it: put  calibration = "calibration/{robot}.toml"  into [dwm]')
        text = path.read_text("utf-8") if path.exists() else None
        before = None if text is None else calibration_file.parse(text, str(path))
        made = datetime.now(UTC).isoformat(timespec="seconds")
        file = making.with_offset(before, learned, made, robot, config)
        make_folder(path.parent)
        atomic_write(path, calibration_file.text_of(file).encode())
        assert file.distance is not None
        was = before.distance[0].robot if before is not None and before.distance is not None else 0.0
        now = file.distance[0].robot
        print(
            f"added to {path}: the robot's own offset was {100 * was:+.2f} cm and is {100 * now:+.2f} cm; swarm deploy "
            "brings it to the robot, before the next offset is learned there"
        )
    return 0


def _commissioned(options: argparse.Namespace, robot: str) -> LearnedOffset:
    """Read what `swarm commission` has learned from its report."""
    learned = making.offset_of(options.recording, robot)
    print(f"{robot}: ranges {100 * learned.offset:+.2f} cm too long under the model in use, at {learned.places} places")
    return learned


def _of_run(options: argparse.Namespace, config: Config, robot: str) -> LearnedOffset:
    """Learn it from a recorded localization run."""
    recording = read_recording(options.recording, options.index)
    if options.place is None:
        raise LocalError("where did the robot stand in this run? give it with --place X Y")
    modules = _modules(options, config)
    target = config.dwm.target or ""
    if target not in modules:
        raise LocalError("where is the target? give it with --target X Y, and its address as [dwm] target")
    models = load_calibration(config, robot).ranges
    found = of_recording(recording, (options.place[0], options.place[1]), target)
    of = groups(found, modules)
    learned = fitting.robot_offset(models, of)
    print(
        f"{robot}: ranges {100 * learned:+.2f} cm too long under the model in use, {recording.steps} at one place.\n"
        "The robot's own offset and this place's error (multipath, a place measured wrongly) are one number here:\n"
        "only another place can tell them apart."
    )
    left = fitting.rms([fitting.error_of(models, group, group.mean) - learned for group in of])
    return LearnedOffset(learned, 1, len(found), left, samples.digest(found))


def _make(
    options: argparse.Namespace, config: Config, robot: str, data: CalibrationData, parts: tuple[str, ...]
) -> int:
    """Fit, tell, draw, write."""
    made = datetime.now(UTC).isoformat(timespec="seconds")
    file = calibration_file.CalibrationFile("", "", ())
    if "distance" in parts:
        part, ranged = making.distance_part(data, made)
        file = file.with_parts(part)
        places = len({g.place for g in data.groups})
        print(making.fit_text("ranges", ranged.name, ranged.left_out, ranged.nested, places, len(data.samples)))
    if "position" in parts:
        part, placed = making.position_part(data, made)
        file = file.with_parts(part)
        print(
            making.fit_text("places", placed.name, placed.left_out, placed.nested, len(data.spots), len(data.samples))
        )
    configured = calibration_path(config, robot)
    path = options.output or configured or config.path.parent / "calibration" / f"{robot}.toml"
    making.save(file, path, robot, config.anchors)
    print(f"written to {path}")
    if configured is None:
        print('no robot reads it yet: put  calibration = "calibration/{robot}.toml"  into [dwm] of swarm.toml')
    if not options.no_plot:
        picture = path.with_suffix(".png")
        plots.draw(data, file.distance and file.distance[0], file.position and file.position[0], picture)
        print(f"residuals drawn in {picture}")
    return 0


def _session(options: argparse.Namespace, config: Config, robot: str, places: list[Place]) -> list[RangeSample]:
    guide = Guide(places, QUARTERS[: options.orientations], options.count)
    module = config.dwm.target or (config.anchors[0].address if config.anchors else "")
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
    path = options.samples or Path(f"calibration-{robot}-{stamp}.csv")
    if os.environ.get("SWARM_RUNTIME") and configuration.who_am_i(config) == robot:
        options.robots = None  # its bus is the one of this environment
    directory = next(iter(buses.directories_of(options).values()))
    with Bus.of(directory) as bus:
        if not bus.wait_connected(5.0):
            raise BusError(f"the bus of {robot} ({directory}) does not answer: does its bus service run?")
        hold(guide, Hearing(bus, robot), module, path, lambda text: print(text, flush=True), clock.now)
    print(f"{len(guide.samples)} samples in {path}")
    if not guide.samples:
        raise LocalError("nothing was measured: does the module give ranges? See swarm dwm check")
    return guide.samples


def _modules(options: argparse.Namespace, config: Config) -> dict[str, Point3]:
    """Places of the modules that ranges go to, heights over the robots' antennas."""
    known = {a.address: (a.x, a.y, a.z - config.dwm.height) for a in config.anchors}
    if options.target is not None and config.dwm.target is not None:
        known[config.dwm.target] = (options.target[0], options.target[1], 0.0)
    return known


def _recorded(options: argparse.Namespace, config: Config) -> list[RangeSample]:
    """Return the samples of `options.samples`; files in the thesis' layout have their places of `--places`."""
    return making.read(options.samples, _read_places(options.places) if options.places else None, config.dwm.target)


def places_of(options: argparse.Namespace, config: Config) -> list[Place]:
    """Return the places at which to measure: those of `--places`, else a grid over the anchors. Raises `LocalError`."""
    if options.places is not None:
        return _read_places(options.places)
    if len(config.anchors) < 2:
        raise LocalError("without anchors in swarm.toml there is no area to calibrate: give the places with --places")
    return grid([(anchor.x, anchor.y) for anchor in config.anchors], options.step)


def _read_places(text: str) -> list[Place]:
    """`x,y x,y ...` or the path of a file with a place a line, in m; `thesis` for those of the thesis' recording."""
    if text == "thesis":
        return list(samples.THESIS_PLACES)
    words = Path(text).read_text("utf-8").split() if Path(text).is_file() else text.split()
    try:
        places = [(float(x), float(y)) for x, y in (word.split(",") for word in words)]
    except ValueError:
        raise LocalError(f'--places: expected "x,y x,y ..." in m, or a file of them, got {text[:60]!r}') from None
    if not places:
        raise LocalError("--places: no place given")
    return places


def _config(options: argparse.Namespace) -> Config:
    """Return the swarm's file; that of a simulation where one runs and none is named."""
    directory = options.run_dir or default_run_dir()
    if not os.environ.get("SWARM_CONFIG") and is_live(directory):
        return configuration.load(directory / CONFIG)
    return configuration.load()


def options_of(argv: list[str], far: str = "") -> argparse.Namespace:
    """Return the arguments of one command; end the process where they are wrong. `far`: the help's last line."""
    parser: argparse.ArgumentParser = CommandParser(
        prog="swarm calibrate",
        description=DESCRIPTION,
        epilog=f"{EPILOG}\n{far}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: object, text: str) -> argparse.ArgumentParser:
        found = add_verb(commands, name, text, far or None)
        buses.add_arguments(found)
        found.set_defaults(run=run)
        found.add_argument("--target", nargs=2, type=float, metavar=("X", "Y"), help="where the target stands, m")
        return found

    for name, what in (("distance", "ranges"), ("position", "the module's places")):
        found = command(name, guided, f"measure at known places and fit {what}")
        _session_arguments(found, 0.5, "file for the samples")
        _file_arguments(found)
    found = command("samples", measure, "measure at known places into a file, and fit nothing")
    _session_arguments(found, 0.5, "file for the samples")
    found = command("check", check, "measure at a few known places and compare with the calibration in use")
    _session_arguments(found, 1.0, "a file of samples to check, or the file for new samples")
    found = command("fit", fit, "fit samples that were recorded before, in our layout or in that of the thesis")
    found.add_argument("samples", type=Path, metavar="SAMPLES", help="a file, or a folder of *.csv")
    found.add_argument(
        "--places", metavar="LIST", help="places of files in the thesis' layout: 'x,y x,y ...' in m, or thesis"
    )
    found.add_argument("--only", choices=("distance", "position"), help="fit one of the two")
    found.add_argument("--thesis", action="store_true", help="print the thesis' figures from its own samples")
    _file_arguments(found)
    found = command(
        "offset", offset, "find a robot's own range offset, from its commissioning or from a run at a known place"
    )
    found.add_argument(
        "recording", type=Path, metavar="RECORDING", help="report of swarm commission, or folder of a run"
    )
    found.add_argument("--index", type=whole(0), default=0, metavar="N", help="number of the robot's file in a run (0)")
    found.add_argument("--place", nargs=2, type=float, metavar=("X", "Y"), help="place of the robot in that run, m")
    found.add_argument("--write", action="store_true", help="add it to the robot's calibration file")
    options = parser.parse_args(argv)
    if len(options.robots or ()) != 1:
        parser.error("--robots NAME is needed: a calibration is one robot's")
    return options


def _session_arguments(parser: argparse.ArgumentParser, step: float, samples: str) -> None:
    parser.add_argument("--places", metavar="LIST", help="'x,y x,y ...' in m, or a file (a grid over the anchors)")
    text = f"spacing of the grid ({step})"
    parser.add_argument("--step", type=number(0, unit="m", above=True), default=step, metavar="M", help=text)
    parser.add_argument(
        "--orientations",
        type=int,
        default=4,
        choices=(1, 2, 3, 4),
        metavar="N",
        help="1 to 4 orientations at each place (4)",
    )
    parser.add_argument(
        "--count", type=whole(1), default=SAMPLES, metavar="N", help=f"reports for each orientation ({SAMPLES})"
    )
    parser.add_argument("--samples", type=Path, metavar="FILE", help=samples)


def _file_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--output", type=Path, metavar="FILE", help="the calibration file (as [dwm] calibration says)")
    parser.add_argument("--no-plot", action="store_true", help="do not draw the residuals")


if __name__ == "__main__":
    service.run(main)
