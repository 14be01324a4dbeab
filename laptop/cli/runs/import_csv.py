"""`swarm import CSVDIR`: the thesis' CSV files as a recorded run, which can be plotted, replayed and exported again."""

import argparse
import hashlib
from pathlib import Path, PurePosixPath

from swarm.errors import LocalError, RecordingError
from swarm.messages import AppState
from swarm.process.arguments import add_json, show
from swarm.recording import folder, thesis_csv
from swarm.recording.reader import SUFFIX
from swarm.recording.virtual_file import DirectRecording

HELP = "convert a folder of the thesis' CSV files into a recorded run"

FILES = "csv"
"""Name of the metadata record that lists the files, each with its topic."""
UNIX = "unix"
"""Names the clock of the files: time of day."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the folder, and where the run goes."""
    parser.add_argument(
        "source", type=Path, metavar="CSVDIR", help="folder with <k>.csv of each robot, or with such folders"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="the run's folder (runs/<name of CSVDIR>)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Write the run and return 0. Raises `LocalError` or `RecordingError` where a file is not one of the thesis'
    layouts."""
    source = args.source.resolve()
    paths = sorted(source.rglob("*.csv")) if source.is_dir() else []
    if not paths:
        raise LocalError(f"{args.source}: there is no folder with CSV files")
    output = args.output or Path("runs") / source.name
    texts = {PurePosixPath(path.relative_to(source)): _read(path) for path in paths}
    kinds = {name: thesis_csv.kind_of(PurePosixPath(source) / name) for name in texts}
    topics = {
        name: f"swarm/{thesis_csv.robot_of(name)}/thesis/{'.'.join(name.with_suffix('').parts)}" for name in texts
    }
    if len(set(topics.values())) < len(topics):
        raise RecordingError(f"{args.source}: two of its files differ only in a dot for a slash: rename one")
    digest = hashlib.blake2b("".join(texts.values()).encode(), digest_size=16).digest()
    app = min(kinds.values())
    info = folder.describe(app, int.from_bytes(digest[:8], "big"), 0, digest)
    about = output / folder.RUN_FILE
    is_new = not about.exists()
    folder.begin(output, info, {})
    file = output / f"{app}{SUFFIX}"
    recording = DirectRecording(file, info, clock=UNIX)
    try:
        recording.metadata(FILES, {str(name): topic for name, topic in topics.items()})
        for name, text in texts.items():
            _put(recording, name, kinds[name], text, topics[name], str(args.source / name))
    except RecordingError:
        recording.close()
        file.unlink()  # the next attempt would find it otherwise
        if is_new:
            about.unlink()
        raise
    recording.close()
    show(args, {"run": str(output), "files": len(texts)}, [str(output)])
    return 0


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None


def _put(recording: DirectRecording, name: PurePosixPath, kind: str, text: str, topic: str, where: str) -> None:
    """Record one file: every line as it is, and its values. Raises `RecordingError` with `where` and the line."""
    prefix = f"swarm/{thesis_csv.robot_of(name)}/app/{kind}"
    # Several experiments in one folder, and files that are of no robot, are told apart as channels are.
    place = ".".join(name.parent.parts) if name.stem.isdecimal() else name.stem
    part = thesis_csv.channel_of(name) or place
    states = f"{prefix}/{part}/state" if part else f"{prefix}/state"
    t = 0.0
    for raw, line in thesis_csv.read(text, kind, where):
        t = line.t if line.t is not None else t + 1.0
        recording.write(topic, t, {"t": t, "line": raw}, "thesis.Line")
        if line.k is not None:
            if line.measurement is not None:
                distance, x, y = line.measurement
                fields = {"t": t, "k": line.k - 1, "distance": distance, "x": x, "y": y}
                recording.write(f"{prefix}/measurement", t, fields, "swarm.Measurement")
            if kind != "calibration":
                message = AppState(t, line.k, dict(line.state), dict(line.result))
                recording.write(states, t, message, f"{kind}.{part or 'State'}")
