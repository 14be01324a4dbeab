"""`swarm key`: make the pre-shared key of a swarm, replace it, and show which ones a file holds."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

from swarm.config.keyfile import new_key_file, read_keys, retire, rotate
from swarm.config.types import DEFAULT_KEY_FILE
from swarm.onboard.command_line import add_verb
from swarm.process.arguments import add_json, show

HELP = "make or replace the key that the robots of a swarm share"

_VERBS = {
    "new": "make a file with a new key, readable by its owner alone; never overwrites",
    "rotate": "add a new key before the old one, which stays valid until `retire`",
    "retire": "end a rotation: remove the older key",
    "show-id": "print the ids of the keys in a file, the newest first; ids are no secret",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="|".join(_VERBS))
    for verb, text in _VERBS.items():
        command = add_verb(verbs, verb, text)
        add_json(command)
        command.add_argument(
            "file", nargs="?", type=Path, metavar="FILE", default=Path(DEFAULT_KEY_FILE), help="key file (%(default)s)"
        )


def run(args: argparse.Namespace) -> int:
    """Make, replace or show a key. Raises `LocalError` where a file is missing, is in the way, or is no key file."""
    path: Path = args.file
    ids = [_DO[args.verb](path)] if args.verb in _DO else read_keys(path)
    shown = [f"{key_id:08x}" for key_id in ids]
    told = {
        "new": f"{path}: key {shown[0]}; copy it to all robots, where only the mesh reads it",
        "rotate": f"{path}: new key {shown[0]} beside the old one; now copy the file to all robots",
        "retire": f"{path}: forgot key {shown[0]}; now copy the file to all robots",
    }
    show(args, {"file": str(path), "ids": shown}, [told[args.verb]] if args.verb in told else shown)
    return 0


_DO: dict[str, Callable[[Path], int]] = {
    "new": lambda path: new_key_file(path, time.time()),
    "rotate": lambda path: rotate(path, time.time()),
    "retire": retire,
}
