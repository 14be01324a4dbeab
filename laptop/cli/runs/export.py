"""`swarm export RUN`: a recorded run as CSV files, in the thesis' layouts or as plain tables, or as one MCAP file."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from laptop.cli.runs.import_csv import FILES
from laptop.foxglove.recorded import RecordedScenes
from laptop.runs import tables
from swarm.app.parameters import number_or_text
from swarm.errors import LocalError, RecordingError
from swarm.process.arguments import add_json, show
from swarm.recording import thesis_csv
from swarm.recording.core.mcap import McapSchema
from swarm.recording.core.writer import Writer
from swarm.recording.file import LIBRARY
from swarm.recording.folder import config_in
from swarm.recording.reader import EPOCH, RUN, RecordingReader
from swarm.recording.run import Run
from swarm.recording.trajectory import Trajectory
from swarm.recording.virtual_file import finish

HELP = "write a recorded run as CSV files, or as one MCAP file on one time axis"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the run, and what to make of it."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or one recording (.mcap)")
    parser.add_argument(
        "--csv", type=Path, metavar="DIR", help="write the thesis' layouts: <k>.csv for each robot, without a header"
    )
    parser.add_argument("--table", type=Path, metavar="DIR", help="write tables with a header: k, t, states, results")
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="TOPIC",
        help="a table of this in place of the states: dwm/pose, balancer/state (tilt, battery), "
        "mesh/links, sim/leds, sim/truth, ...; may be repeated",
    )
    parser.add_argument("--format", choices=tables.FORMATS, default="csv", help="file format of the tables (csv)")
    parser.add_argument("--mcap", type=Path, metavar="FILE", help="write all robots into one file, on one time axis")
    parser.add_argument(
        "--app", default="", metavar="NAME", help="app to export, if robots ran several (default: the run's first app)"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Write the files and return 0. Raises `LocalError` where there is nothing to export."""
    if not (args.csv or args.table or args.mcap):
        raise LocalError("say what to make of the run: --csv DIR, --table DIR or --mcap FILE")
    if args.table:
        tables.require(args.format)  # before anything is written
    recorded = Run(args.run, args.app)
    made: list[Path] = []
    notes: list[str] = []
    if args.csv:
        made += _write(args.csv, _lines(recorded) or _layouts(recorded, notes) or _nothing(recorded))
    if args.table:
        for name, table in _tables(recorded, args.topic).items():
            made.append(args.table / f"{name}.{args.format}")
            tables.write(made[-1], table)
    if args.mcap:
        _merge(recorded, args.mcap)
        made.append(args.mcap)
    paths, damage = list(map(str, made)), [*recorded.damage, *notes]
    show(args, {"files": paths, "damage": damage}, [*paths, *(f"note: {each}" for each in damage)])
    return 0


def _write(place: Path, files: Mapping[str, str]) -> list[Path]:
    for name, text in files.items():
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", newline="") as file:
            file.write(text)
    return [place / name for name in files]


def _lines(recorded: Run) -> dict[str, str]:
    """Return the files that a run was imported from, with the same bytes."""
    files = {name: topic for entries in recorded.notes(FILES) for name, topic in entries.items()}
    lines: dict[str, list[str]] = {topic: [] for topic in files.values()}
    for path in recorded.files if files else ():
        for sample in RecordingReader(path).samples(
            lines.__contains__
        ):  # in the order of the lines, not of their times
            lines[sample.topic].append(sample.message["line"])
    return {name: "".join(lines[topic]) for name, topic in files.items()}


def _layouts(recorded: Run, notes: list[str]) -> dict[str, str]:
    """Return a run of ours in the thesis' layouts, that of localization where the app has measured. Robots are numbered
    in the order of their names. States that a layout cannot hold are counted in `notes`."""
    began = recorded.epoch + recorded.origin
    files = {}
    for channel in recorded.states():
        paths = recorded.trajectories(channel=channel)
        prefix = f"{channel}/" if channel else ""
        for robot, path in paths.items():
            number = recorded.robots.index(robot)
            ks = sorted(path.rows)
            times = [began + path.times[k] for k in ks]
            placed = not channel and {"result.x", "result.y"} <= set(path.columns)
            if placed and (measured := _measured(recorded, robot)):
                rows = [
                    (k, t, path.value(k, "result.x"), path.value(k, "result.y")) for k, t in zip(ks, times, strict=True)
                ]
                files[f"{number}.csv"] = thesis_csv.localization(rows, measured)
                if lost := sum(k not in measured for k in ks[1:]):
                    notes.append(f"{robot}: {lost} states without a recorded measurement are not in {number}.csv")
            else:
                if ks and len(ks) < ks[-1] + 1:
                    lost = ks[-1] + 1 - len(ks)
                    notes.append(f"{robot}: {lost} iterations are missing: the layout has none, later rows move up")
                shared = [index for index, name in enumerate(path.columns) if not name.startswith("result.")]
                cells = [[path.rows[k][index] for index in shared] for k in ks]
                files[f"{prefix}{number}.csv"] = thesis_csv.states(list(zip(times, cells, strict=True)))
    return files


def _measured(recorded: Run, robot: str) -> dict[int, tuple[float, float, float]]:
    """Return the measurements of a robot by the state that they gave: the one of step k gave state k + 1."""
    found = {}
    for sample in recorded.samples(f"swarm/{robot}/app/{recorded.app}/measurement"):
        message = sample.message
        found[message["k"] + 1] = (message["distance"], message["x"], message["y"])
    return found


def _tables(recorded: Run, topics: Sequence[str]) -> dict[str, tables.Table]:
    """Return the tables by the name of their file: one of each topic, or else of the states of each robot."""
    if topics:
        return {topic.replace("/", "."): tables.of_topic(recorded, topic) for topic in topics}
    found = {
        ".".join(filter(None, (robot, recorded.app, channel))): _table(path)
        for channel in recorded.states()
        for robot, path in recorded.trajectories(channel=channel).items()
    }
    if not found:
        return _nothing(recorded)
    return found


def _nothing(recorded: Run) -> NoReturn:
    raise RecordingError("; ".join([f"{recorded.path}: no app's states are recorded", *recorded.damage]))


def _table(path: Trajectory) -> tables.Table:
    ks = sorted(path.rows)
    table: tables.Table = {"k": list(ks), "t": [path.times[k] for k in ks]}
    for at, name in enumerate(path.columns):
        table[f"app.{name}" if name in table else name] = [_value(path.rows[k][at]) for k in ks]
    return table


def _value(text: str) -> object:
    """Return a cell as the value from which it was written."""
    return text == "True" if text in ("True", "False") else number_or_text(text)


def _merge(recorded: Run, path: Path) -> None:
    """Write the run into one file. Its times count from the time of day at which the run began, as far as that is
    known."""
    epoch_ns = round((recorded.epoch + recorded.origin) * 1e9)
    writer = Writer(LIBRARY, epoch_ns=epoch_ns)
    writer.metadata(RUN, {**recorded.info, EPOCH: str(epoch_ns)})
    with path.open("x+b") as file:
        config = config_in(recorded.path)
        scenes = None if config is None else RecordedScenes(config, epoch_ns)
        for sample in recorded.samples():
            writer.write_text(sample.topic, sample.t, sample.data, recorded.schemas[sample.topic])
            for made in () if scenes is None else scenes.after(sample):
                schema = McapSchema(0, made.schema_name, "jsonschema", made.schema)
                writer.write_text(made.topic, sample.t, made.data, schema)
            file.write(writer.take())
        finish(writer, file)
