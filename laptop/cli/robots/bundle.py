"""`swarm bundle FOLDER`: all that `swarm provision` brings to robots that have no internet."""

import argparse
import subprocess
from pathlib import Path

import swarm
from laptop.fleet import bundle
from laptop.fleet.core.wish import PACKAGES, SUITES
from laptop.fleet.install import read_release
from swarm.errors import LocalError
from swarm.onboard.arguments import add_json, show

HELP = "gather what robots without internet need, for swarm provision: packages, releases"

MACHINES = {"arm64": "aarch64", "amd64": "x86_64"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to, and what for."""
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="is made; what is there of the same kind is replaced"
    )
    parser.add_argument("--suite", action="append", choices=[*SUITES], help="Debian of the robots; all of them")
    parser.add_argument("--architecture", default="arm64", choices=[*MACHINES], help="of the robots (arm64)")
    parser.add_argument("--mirror", default=bundle.DEBIAN, metavar="URL", help="of Debian (%(default)s)")
    parser.add_argument(
        "--pi-key", type=Path, metavar="FILE", help=f"of Raspberry Pi's archive, a robot's {bundle.PI_KEYS[0]}"
    )
    add_json(parser)
    parser.add_argument("--no-releases", action="store_true", help="packages only")


def run(args: argparse.Namespace) -> int:
    """One folder of packages and one release for each Debian."""
    key = args.pi_key or next((path for path in bundle.PI_KEYS if path.exists()), None)
    packages = [*PACKAGES, *(bundle.PI_PACKAGES if key is not None else ())]
    script = Path(swarm.__file__).parents[1] / "deploy/release"
    if not args.no_releases and not script.exists():
        raise LocalError(f"there is no {script}: call this from a checkout, or with --no-releases")
    folders, releases, lines = {}, [], []
    for suite in dict.fromkeys(args.suite or SUITES):
        folder = args.folder / f"{suite}-{args.architecture}"
        sources = bundle.archives(suite, args.mirror, key)
        count, size = bundle.download(folder, sources, args.architecture, packages)
        folders[str(folder)] = {"packages": count, "bytes": size}
        lines.append(f"{folder}: {count} packages, {size / 1e6:.0f} MB")
        if not args.no_releases:
            releases.append(str(_release(script, args.folder, MACHINES[args.architecture], SUITES[suite])))
            lines.append(releases[-1])
    if key is None:
        lines.append(
            f"without Raspberry Pi's archive (--pi-key): robots need an image with {' and '.join(bundle.PI_PACKAGES)}"
        )
    show(args, {"folders": folders, "releases": releases}, lines)
    return 0


def _release(script: Path, folder: Path, machine: str, python: str) -> Path:
    """Make it there, in place of an older one for the same robots; returns its path."""
    words = [str(script), "--machine", machine, "--python", python, str(folder)]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        raise LocalError(f"{script} failed, see above")
    made = read_release(Path(done.stdout.split()[-1]))
    for path in folder.glob("balboa-swarm-*.tar.gz"):
        other = read_release(path)
        if (other.machine, other.python) == (machine, python) and other.identity != made.identity:
            path.unlink()
    return made.path
