"""The files that an app is made of: its own, and the modules beside it that it imports, and those that they import."""

import ast
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from swarm import packages


def of_app(path: Path) -> dict[str, bytes]:
    """Return the content of each file of the app in `path`, by its name within the app's folder.

    An import of `helper` means `helper.py` or the folder `helper` beside the app's file, where there is one. All
    modules of such a folder belong to the app. What cannot be read as Python imports nothing. Raises `OSError`.
    """
    folder = path.parent
    found: dict[str, bytes] = {}
    waiting = [path]
    while waiting:
        file = waiting.pop()
        name = str(file.relative_to(folder))
        if name not in found:
            found[name] = file.read_bytes()
            tops = {each.partition(".")[0] for _, each in imports(found[name])}
            waiting += [each for top in sorted(tops) for each in beside(folder, top)]
    return dict(sorted(found.items()))


def digest(files: Mapping[str, bytes]) -> bytes:
    """Return the hash of an app's files and their names, 16 bytes."""
    whole = hashlib.blake2b(digest_size=16)
    for name, data in sorted(files.items()):
        whole.update(hashlib.blake2b(name.encode()).digest() + hashlib.blake2b(data).digest())
    return whole.digest()


def beside(folder: Path, top: str) -> list[Path]:
    """Return the files of the module `top` in an app's folder; none where it is not there.

    In a checkout the platform's packages are beside an app that lies in its first folder. They are no part of the app.
    """
    if top in packages.NAMES and folder.resolve() == packages.HOME:
        return []
    package = folder / top
    if top and package.is_dir():
        return sorted(each for each in package.rglob("*.py") if "__pycache__" not in each.parts)
    return [path] if top and (path := folder / f"{top}.py").is_file() else []


def imports(source: bytes) -> Iterator[tuple[int, str]]:
    """Yield line and name of each import, but of those for type checkers alone."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return
    yield from _imports(tree)


def _imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0:
                yield node.lineno, node.module or ""
            else:  # from . import helper: beside this file
                names = [node.module] if node.module else [alias.name for alias in node.names]
                yield from ((node.lineno, name) for name in names)
        else:
            yield from _imports(node)
