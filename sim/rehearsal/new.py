"""`swarm new FILE`: a commented app that runs, and its test beside it."""

import argparse
import importlib.util
import sys
from pathlib import Path

from services.apps.loader import BUILT_IN
from sim.rehearsal.templates import KINDS, fill
from swarm import packages
from swarm.errors import LocalError
from swarm.messages.keys import is_name
from swarm.process import service


def main() -> int:
    """Write both files, or none."""
    parser = argparse.ArgumentParser(prog="swarm new", description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path, metavar="FILE.py", help="its name without .py is the app's name on the bus")
    kinds = "sync: all robots step together (default); periodic: each by its own clock; event: handlers"
    parser.add_argument("--kind", choices=list(KINDS), default="sync", help=kinds)
    options = parser.parse_args()
    for path in write(options.file, options.kind):
        sys.stdout.write(f"wrote {path}\n")
    file, test = options.file, beside(options.file)
    start = " --set r2.value=6" if options.kind == "sync" else ""  # all begin at zero otherwise: nothing would move
    install = "" if importlib.util.find_spec("pytest") else "pip install pytest; "
    sys.stdout.write(f"next: swarm check {file}; {install}pytest {test}; swarm sim {file} --robots 6{start}\n")
    return 0


def write(path: Path, kind: str) -> tuple[Path, Path]:
    """The two files that were written; `LocalError` where one cannot be, or is there already."""
    name = path.stem
    if path.suffix != ".py" or not is_name(name) or not name.isidentifier():
        raise LocalError(f"{path}: expected NAME.py, NAME a lower-case letter, then up to 15 letters, digits or _")
    if name in BUILT_IN:
        raise LocalError(f"{path}: there is a built-in app of that name; take another one")
    if name in packages.NAMES:
        raise LocalError(f"{path}: a package of Balboa Swarm has that name; take another one")
    files = (path, beside(path))
    for file in files:
        if file.exists():
            raise LocalError(f"{file}: is there already; it is not written over")
    if not path.parent.is_dir():
        raise LocalError(f"{path.parent}: there is no such folder")
    for file, text in zip(files, KINDS[kind], strict=True):
        file.write_text(fill(text, name))
    return files


def beside(path: Path) -> Path:
    """Return the path of an app's test."""
    return path.with_name(f"test_{path.stem}.py")


if __name__ == "__main__":
    service.run(main)
