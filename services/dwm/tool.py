"""`swarm dwm info|configure|anchors|check`: a robot's UWB module, or one at a serial port of this machine.

Robots are asked over their buses (of a simulation, or the robot this runs on); their dwm service has the port. Exit
codes: 0 all is well or there are notes alone, 1 something is wrong or a module did not answer, 2 the command or
swarm.toml is wrong.
"""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from services.dwm import configure, truth
from services.dwm.anchors import survey
from services.dwm.configure import DesiredModule, ModuleInfo
from services.dwm.core.calibration.models import RangeModel
from services.dwm.core.module import calls, diagnosis
from services.dwm.core.module.diagnosis import ModuleFinding
from services.dwm.core.module.tlv import Location, Position
from services.dwm.line import BusLine, ModuleConnection, NoAnswerError, PortLine
from services.dwm.localizer import known_modules, load_calibration, uncalibrated
from swarm.config import Config, load
from swarm.config.find import find
from swarm.errors import ConfigError, LocalError
from swarm.onboard.buses import buses
from swarm.onboard.command_line import add_verb
from swarm.process.arguments import add_json, number, show
from swarm.process.simulations import CONFIG

SECONDS = 3.0
"""Seconds that `check` and `anchors` listen to ranges."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what can be done, each with its arguments."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, (text, _) in VERBS.items():
        verb = add_verb(verbs, name, text, parser.epilog)
        buses.add_arguments(verb)
        add_json(verb)
        verb.add_argument("--port", action="append", metavar="PATH", help="a module at a serial port of this machine")
        verb.add_argument("--config", type=Path, metavar="FILE", help="swarm.toml (the simulation's, or the usual one)")
        if name == "configure":
            role = verb.add_mutually_exclusive_group()
            role.add_argument("--tag", action="store_true", help="make it a tag (default: as swarm.toml says)")
            role.add_argument("--anchor", action="store_true", help="make it an anchor")
            verb.add_argument(
                "--initiator", action="store_true", help="make the anchor start the network; exactly one anchor must"
            )
            verb.add_argument("--at", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where the anchor is, m")
        if name == "anchors":
            verb.add_argument("--auto", action="store_true", help="find the anchors' places from their distances")
            verb.add_argument("--ranges", type=Path, metavar="FILE", help="with --auto: lines `D001 D002 1.94` (m)")
        if name in ("anchors", "check"):
            listening = "time of listening (3; --auto: 5 at each place; --truth: 10)"
            verb.add_argument("--seconds", type=number(0, unit="s", above=True), metavar="S", help=listening)
        if name == "check":
            against = "compare with the places on this key (motion capture); sim/truth: those of a simulation"
            verb.add_argument("--truth", metavar="KEY", help=against)


def run(args: argparse.Namespace) -> int:
    """Return 0 where nothing is wrong, notes aside, and 1 where something is wrong or a module did not answer."""
    config = _config(args)
    try:
        with contextlib.ExitStack() as stack:
            lines = [] if getattr(args, "ranges", None) else list(_lines(args, stack))
            return VERBS[args.verb][1](args, config, lines)
    except NoAnswerError as error:
        sys.stderr.write(f"swarm: {error}\n")
        return 1


def _config(args: argparse.Namespace) -> Config | None:
    """Return the swarm.toml that goes with what is asked; None on a laptop without one."""
    path: Path | None = args.config
    if path is None and args.port is None and not getattr(args, "ranges", None):
        directories = buses.directories_of(args)
        simulated = next(iter(directories.values())).parent / CONFIG
        path = simulated if simulated.is_file() and "SWARM_CONFIG" not in os.environ else None
    if path is not None:
        return load(path)
    path = find()
    return None if path is None else load(path)


def _lines(args: argparse.Namespace, stack: contextlib.ExitStack) -> Iterator[ModuleConnection]:
    if args.port and (args.robots or args.run_dir):
        raise LocalError("--port is a module of this machine, --robots and --run-dir are others': use one of them")
    found: Iterator[ModuleConnection] = (
        (PortLine(path) for path in args.port)
        if args.port
        else (BusLine(robot, directory) for robot, directory in buses.directories_of(args).items())
    )
    for line in found:
        stack.callback(line.close)
        yield line


def _of_each(
    lines: Sequence[ModuleConnection], ask: Callable[[ModuleConnection], dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Return what `ask` says of each module, by the module's name; the problem with one that does not answer."""
    told = {}
    for line in lines:
        try:
            told[line.name] = ask(line)
        except NoAnswerError as error:
            told[line.name] = {"problem": str(error)}
    return told


# -- info --------------------------------------------------------------------------------------------------------


def _info(args: argparse.Namespace, config: Config | None, lines: Sequence[ModuleConnection]) -> int:
    del config
    told = _of_each(lines, lambda line: _as_json(configure.inspect(line)))
    text: list[str] = []
    for name, fields in told.items():
        text += [name, *(f"  {field:<12} {value}" for field, value in _flat(fields))]
    show(args, told, text)
    return 1 if any("problem" in fields for fields in told.values()) else 0


def _as_json(info: ModuleInfo) -> dict[str, Any]:
    return {
        "address": info.address,
        "id": f"{info.identity:016X}",
        "firmware": info.version.text,
        "role": "anchor" if info.settings.anchor else "tag",
        "settings": asdict(info.settings),
        "moving": info.rate.moving * calls.RATE_UNIT,
        "still": info.rate.still * calls.RATE_UNIT,
        "place": asdict(info.place),
        "joined": info.status.joined,
    }


def _flat(fields: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for name, value in fields.items():
        if name == "settings":
            on = [word for word, is_on in value.items() if is_on is True and word != "anchor"]
            yield name, ", ".join(on) or "-"
        elif name == "place":
            yield name, f"({value['x']:g}, {value['y']:g}, {value['z']:g}) m, quality {value['quality']}"
        elif name in ("moving", "still"):
            yield name, f"a measurement every {value:g} s"
        else:
            yield name, str(value)


# -- configure ---------------------------------------------------------------------------------------------------


def _configure(args: argparse.Namespace, config: Config | None, lines: Sequence[ModuleConnection]) -> int:
    if (args.initiator or args.at) and args.tag:
        raise LocalError("--initiator and --at are for anchors")

    def configured(line: ModuleConnection) -> dict[str, Any]:
        info = configure.inspect(line)
        wish = _wish(args, config, line, info)
        changes = configure.apply(line, wish)
        missing = configure.unfulfilled(configure.inspect(line), wish) if changes else []
        return {"address": info.address, "changes": changes, "missing": missing}

    told = _of_each(lines, configured)
    text: list[str] = []
    for name, fields in told.items():
        words = fields.get("problem") or "; ".join(fields["changes"]) or "is as it shall be"
        text += [f"{name} {fields.get('address', '')}: {words}", *(f"  {m}" for m in fields.get("missing", []))]
    show(args, told, text)
    return 1 if any("problem" in fields or fields["missing"] for fields in told.values()) else 0


def _wish(args: argparse.Namespace, config: Config | None, line: ModuleConnection, info: ModuleInfo) -> DesiredModule:
    place = None
    if args.at:
        x, y, z = args.at
        place = Position(x, y, z, 100)
    known = configure.wish_of(config, info.address)
    if args.anchor or args.initiator or args.at:
        return DesiredModule(True, True if args.initiator else None, place=place or (known.place if known else None))
    if args.tag:
        return DesiredModule(False)
    if known is not None:
        return known
    if isinstance(line, BusLine) and config is not None:
        return DesiredModule(config.robot(line.name).uwb_role == "anchor")
    raise LocalError(f"{line.name}: swarm.toml does not know module {info.address}: say --tag or --anchor")


# -- check -------------------------------------------------------------------------------------------------------


def _check(args: argparse.Namespace, config: Config | None, lines: Sequence[ModuleConnection]) -> int:
    if args.truth:
        return _against_truth(args, config, lines)
    told = {line.name: findings_of(line, config, args.seconds or SECONDS) for line in lines}
    text: list[str] = []
    for name, found in told.items():
        text.append(f"{name}: {'all is well' if not found else ''}".rstrip())
        for finding in found:
            mark = "wrong" if finding.fatal else "note"
            text += [f"  {mark:<5}  {finding.code}: {finding.text}", f"         {finding.remedy}"]
    show(args, {name: [asdict(finding) for finding in found] for name, found in told.items()}, text)
    return 1 if any(finding.fatal for found in told.values() for finding in found) else 0


def _against_truth(args: argparse.Namespace, config: Config | None, lines: Sequence[ModuleConnection]) -> int:
    robots = [line for line in lines if isinstance(line, BusLine)]
    if config is None or len(robots) < len(lines):
        raise LocalError("--truth compares what robots say on their buses: give --robots, not --port")
    seconds = args.seconds or truth.SECONDS
    told = {line.name: truth.compare(line, config, args.truth, seconds, _wait) for line in robots}
    text = [words for name, found in told.items() for words in truth.lines_of(name, args.truth, found)]
    show(args, told, text)
    return 0 if all(found["pose"] for found in told.values()) else 1


def findings_of(line: ModuleConnection, config: Config | None, seconds: float) -> list[ModuleFinding]:
    """Everything that is wrong with a module and what it sees."""
    robot = line.name if isinstance(line, BusLine) else None
    found: list[ModuleFinding] = []
    try:
        info = configure.inspect(line)
        if robot is None and config is not None:
            robot = config.robots_by_module.get(info.address)
        found += diagnosis.of_version(info.version)
        anchor = _shall_be_anchor(config, robot, info)
        found += diagnosis.of_settings(info.settings, info.rate, info.status, anchor=anchor)
        if config is None:
            return found
        found += diagnosis.of_anchors(config.anchors)
        if info.settings.anchor or info.settings.uwb != calls.UWB_ACTIVE:
            return found
        locations = survey.sample(line, seconds, _wait)
    except NoAnswerError as error:
        # A service that refuses its calibration does not run, and nobody answers.
        return [*found, diagnosis.of_trouble(error.trouble), *_of_calibration(config, robot)]
    unfit = _of_calibration(config, robot)
    found += [*unfit, *diagnosis.of_answers(locations, config.anchors, known_modules(config), info.address)]
    calibrate = _calibrate(config, None if unfit else robot)
    return found + diagnosis.of_standing(locations, config.anchors, config.dwm.height, calibrate)


def _shall_be_anchor(config: Config | None, robot: str | None, info: ModuleInfo) -> bool:
    wish = configure.wish_of(config, info.address)
    if wish is not None:
        return wish.anchor
    if config is not None and robot is not None:
        return config.robot(robot).uwb_role == "anchor"
    return info.settings.anchor


def _of_calibration(config: Config | None, robot: str | None) -> list[ModuleFinding]:
    """Return whether the robot's calibration is one of these anchors."""
    if config is None or robot is None:
        return []
    try:
        load_calibration(config, robot)
    except ConfigError as error:
        return [
            ModuleFinding("calibration", str(error), f"calibrate anew: `swarm calibrate distance --robots {robot}`")
        ]
    if problem := uncalibrated(config, robot):
        return [ModuleFinding("calibration", problem, f"`swarm calibrate distance --robots {robot}`", fatal=False)]
    return []


# -- anchors -----------------------------------------------------------------------------------------------------


def _anchors(args: argparse.Namespace, config: Config | None, lines: Sequence[ModuleConnection]) -> int:
    if args.auto:
        from services.dwm.anchors.layout import lay_out  # needs numpy, which no robot has

        return lay_out(args, config, lines, _calibrate(config, args.robots[0] if args.robots else None), _wait)
    if args.ranges:
        raise LocalError("--ranges goes with --auto")

    def seen(line: ModuleConnection) -> dict[str, Any]:
        robot = line.name if isinstance(line, BusLine) else None
        return _seen(survey.sample(line, args.seconds or SECONDS, _wait), config, robot)

    told = _of_each(lines, seen)
    text: list[str] = []
    for name, rows in told.items():
        text += [f"{name}: {rows['problem']}"] if "problem" in rows else [name, *_table(rows)]
    show(args, told, text)
    return 1 if any("problem" in rows or len(rows) < diagnosis.ENOUGH for rows in told.values()) else 0


def _seen(locations: Sequence[Location], config: Config | None, robot: str | None) -> dict[str, dict[str, Any]]:
    """Return by address: the distance, how often it came, the module's own place and that of swarm.toml."""
    calibrate = _calibrate(config, robot)
    listed = {anchor.address: anchor for anchor in config.anchors} if config else {}
    robots = config.robots_by_module if config else {}
    rows: dict[str, dict[str, Any]] = {}
    for address in sorted({item.anchor for location in locations for item in location.ranges} | listed.keys()):
        items = [item for location in locations for item in location.ranges if item.anchor == address]
        values = sorted(calibrate(address, item.distance) for item in items)
        said = items[-1].position if items else None
        place = listed.get(address)
        rows[address] = {
            "answers": len(items),
            "of": len(locations),
            "distance": values[len(values) // 2] if values else None,
            "spread": values[-1 - len(values) // 10] - values[len(values) // 10] if values else None,
            "said": [said.x, said.y, said.z] if said is not None and said.quality else None,
            "listed": [place.x, place.y, place.z] if place is not None else None,
            "robot": robots.get(address),
        }
    return rows


def _table(rows: dict[str, dict[str, Any]]) -> Iterator[str]:
    yield f"  {'address':<8} {'distance':>9} {'spread':>7} {'answers':>8}  {'it says':<20} {'swarm.toml':<20} robot"
    for address, row in rows.items():
        distance, spread = (f"{row[k]:.2f} m" if row[k] is not None else "-" for k in ("distance", "spread"))
        places = ("-" if row[k] is None else "({:.2f}, {:.2f}, {:.2f})".format(*row[k]) for k in ("said", "listed"))
        answers = f"{row['answers']}/{row['of']}"
        yield "  {:<8} {:>9} {:>7} {:>8}  {:<20} {:<20} {}".format(
            address, distance, spread, answers, *places, row["robot"] or ""
        ).rstrip()


def _calibrate(config: Config | None, robot: str | None) -> survey.Calibrate:
    """Raises `ConfigError` where the robot's calibration does not fit."""
    if config is None:
        model = RangeModel()
    else:
        model = load_calibration(config, robot).ranges if robot else RangeModel.of(config.dwm.distance)
    return lambda _, measured: model.distance(measured)


def _wait(seconds: float) -> None:
    time.sleep(max(0.0, seconds))


Verb = Callable[[argparse.Namespace, Config | None, Sequence[ModuleConnection]], int]

VERBS: dict[str, tuple[str, Verb]] = {
    "info": ("show a module's address, firmware, role, rates and place", _info),
    "configure": ("configure a module as swarm.toml says: tag or anchor, 10 Hz also at rest", _configure),
    "anchors": ("show the modules to which there are ranges; --auto: compute their places", _anchors),
    "check": ("show what is wrong, and what to do", _check),
}
