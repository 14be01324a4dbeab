"""`swarm bundle FOLDER`: all that `swarm provision` brings to robots that have no internet."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from laptop.fleet.core.wish import PACKAGES, SUITES
from laptop.fleet.release import bundle
from laptop.fleet.release.install import read_release
from laptop.fleet.release.release import build
from swarm.config import load
from swarm.config.find import LOOKED_IN, find
from swarm.process.arguments import add_json, show

HELP = "download packages and releases that swarm provision needs for robots without internet"

MACHINES = {"arm64": "aarch64", "amd64": "x86_64"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="folder to write; packages and releases in it are replaced"
    )
    parser.add_argument(
        "--suite", action="append", choices=[*SUITES], help="Debian release of the robots (default: all)"
    )
    parser.add_argument("--architecture", default="arm64", choices=[*MACHINES], help="processor of the robots (arm64)")
    parser.add_argument("--mirror", default=bundle.DEBIAN, metavar="URL", help="Debian's archive (%(default)s)")
    parser.add_argument(
        "--pi-key",
        type=Path,
        metavar="FILE",
        help=f"key of Raspberry Pi's archive: a robot has it as {bundle.PI_KEYS[0]}",
    )
    add_json(parser)
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help=f"swarm.toml with [robot] packages (default: {LOOKED_IN})"
    )
    parser.add_argument("--no-releases", action="store_true", help="leave the releases out")


def run(args: argparse.Namespace) -> int:
    """Write a folder of packages and a release for each Debian."""
    key = args.pi_key or next((path for path in bundle.PI_KEYS if path.exists()), None)
    packages = [*PACKAGES, *(bundle.PI_PACKAGES if key is not None else ())]
    path = args.config or find()
    wanted = () if path is None else load(path, addressed=False).packages
    folders, releases, lines = {}, [], []
    for suite in dict.fromkeys(args.suite or SUITES):
        folder = args.folder / f"{suite}-{args.architecture}"
        sources = bundle.archives(suite, args.mirror, key)
        count, size = bundle.download(folder, sources, args.architecture, packages)
        folders[str(folder)] = {"packages": count, "bytes": size}
        lines.append(f"{folder}: {count} packages, {size / 1e6:.0f} MB")
        if not args.no_releases:
            made = _release(args.folder, MACHINES[args.architecture], SUITES[suite], wanted)
            releases.append(str(made))
            lines.append(releases[-1])
    if key is None:
        lines.append(
            f"without Raspberry Pi's archive (--pi-key): robots need an image with {' and '.join(bundle.PI_PACKAGES)}"
        )
    show(args, {"folders": folders, "releases": releases}, lines)
    return 0


def _release(folder: Path, machine: str, python: str, packages: Sequence[str]) -> Path:
    """Make a release in the folder, in place of an older one for the same robots, and return its path."""
    made = read_release(build(folder, machine, python, packages))
    for path in folder.glob("balboa-swarm-*.tar.gz"):
        other = read_release(path)
        if (other.machine, other.python) == (machine, python) and other.identity != made.identity:
            path.unlink()
    return made.path
