"""`swarm new FILE`: a commented app that runs, and its test beside it; or an example (`--from NAME`)."""

import argparse
import importlib.util
import keyword
import shutil
import sys
from pathlib import Path

from services.apps.loader import BUILT_IN
from sim.rehearsal.templates import KINDS, fill
from swarm import packages
from swarm.errors import LocalError
from swarm.messages.keys import is_name

HELP = "write a commented app and its test, or copy an example"

EXAMPLES = packages.PARTS / "examples"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the file of an app, or an example."""
    help_file = "its name without .py is the app's name on the bus"
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE.py", help=help_file)
    parser.add_argument("--from", dest="example", metavar="NAME", help=f"copy an example here: {', '.join(examples())}")
    kinds = "sync: all robots step together (default); periodic: each by its own clock; event: handlers"
    parser.add_argument("--kind", choices=list(KINDS), help=kinds)


def run(args: argparse.Namespace) -> int:
    """Write an app and its test, both or none; or copy an example. Raises `LocalError`."""
    if (args.file is None) == (args.example is None):
        raise LocalError("new: expected either FILE.py for an app, or --from NAME for an example")
    if args.example is not None:
        if args.kind is not None:
            raise LocalError("--kind goes with FILE.py: an example has the kind it has")
        sys.stdout.write(f"wrote {copy(args.example, Path())}\n")
        return 0
    kind = args.kind or "sync"
    for path in write(args.file, kind):
        sys.stdout.write(f"wrote {path}\n")
    file, test = args.file, beside(args.file)
    start = " --set r2.value=6" if kind == "sync" else ""  # all begin at zero otherwise: nothing would move
    install = "" if importlib.util.find_spec("pytest") else "pip install pytest; "
    sys.stdout.write(f"next: swarm check {file}; {install}pytest {test}; swarm sim {file} --robots 6{start}\n")
    return 0


def write(path: Path, kind: str) -> tuple[Path, Path]:
    """Write an app and its test, and return both files. Raises `LocalError` where one cannot be written, or exists."""
    name = path.stem
    if path.suffix != ".py" or not is_name(name) or not name.isidentifier() or keyword.iskeyword(name):
        raise LocalError(
            f"{path}: expected NAME.py, NAME a lower-case letter, then up to 15 letters, digits or _, no keyword"
        )
    if name in BUILT_IN:
        raise LocalError(f"{path}: there is a built-in app of that name; take another one")
    if name in packages.NAMES:
        raise LocalError(f"{path}: a package of Balboa Swarm has that name; take another one")
    files = (path, beside(path))
    for file in files:
        if file.exists():
            raise LocalError(f"{file}: is there already; it is not written over")
    if name in sys.stdlib_module_names or _is_installed(name):
        raise LocalError(
            f"{path}: programs in this folder would import it in place of Python's {name}; take another name"
        )
    if not path.parent.is_dir():
        raise LocalError(f"{path.parent}: there is no such folder")
    for file, text in zip(files, KINDS[kind], strict=True):
        file.write_text(fill(text, name))
    return files


def _is_installed(name: str) -> bool:
    """Return whether a package of this name is installed. An author's own module, on the path by chance, is none."""
    found = importlib.util.find_spec(name)
    origin = "" if found is None else found.origin or ""
    return not {"site-packages", "dist-packages"}.isdisjoint(Path(origin).parts)


def examples() -> list[str]:
    """Return the names of the files and folders that `copy` knows."""
    return sorted(path.name for path in EXAMPLES.iterdir() if not path.name.startswith((".", "_")))


def copy(name: str, folder: Path) -> Path:
    """Copy an example into `folder`; returns its path there. The suffix .py may be left out.

    Raises `LocalError` where there is no such example, or something of its name is there already.
    """
    known = examples()
    found = next((each for each in (name, f"{name}.py") if each in known), None)
    if found is None:
        raise LocalError(f"there is no example {name!r}; there are {', '.join(known)}")
    source, target = EXAMPLES / found, folder / found
    if target.exists():
        raise LocalError(f"{target}: is there already; it is not written over")
    if source.is_dir():
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        shutil.copyfile(source, target)
    return target


def beside(path: Path) -> Path:
    """Return the path of an app's test."""
    return path.with_name(f"test_{path.stem}.py")
