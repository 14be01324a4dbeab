"""Arrangements of the page's panels, kept in a file under names.

The page cannot keep them itself: its port, hence its origin, changes with each start of the server.
"""

import contextlib
import json
import threading
from pathlib import Path
from typing import Any

from swarm.config.find import user_folder
from swarm.errors import LocalError
from swarm.files import atomic_write, make_folder

MAX_LAYOUTS = 40
MAX_PANELS = 24
MAX_NAME = 40
MAX_SPAN = 6

Panel = tuple[str, int, int]
"""A panel's name, and the columns and rows that it spans."""


def default_path() -> Path:
    """Return the file of this user's layouts: `~/.config/swarm/view.json`, as XDG has it."""
    return (user_folder() or Path.home() / ".config" / "swarm") / "view.json"


class Layouts:
    """The layouts as this server and others of the user have written them."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self.current = ""
        """Name of the layout that was used last; empty: the page's own layout."""
        self.named: dict[str, list[Panel]] = {}
        self._read()

    def told(self) -> dict[str, Any]:
        """Return the layouts as a page gets them."""
        return {"current": self.current, "layouts": {name: list(map(list, each)) for name, each in self.named.items()}}

    def keep(self, asked: Any) -> str:
        """Carry out `{name, panels}`, and return in words what was done. With `panels`, keep them under the name and
        use them; with null for them, forget the name; without them, use the layout of that name, or the page's own
        where the name is empty. Raises `LocalError`."""
        if not isinstance(asked, dict) or not isinstance(asked.get("name"), str):
            raise LocalError("layout: expected {name, panels}")
        with self._lock:
            self._read()  # another server may have written the file since
            named, name = dict(self.named), asked["name"]
            if "panels" not in asked:
                if name and name not in named:
                    raise LocalError(f"layout: there is none called {name[:MAX_NAME]!r}")
                current, said = name, f"layout: {name or 'by kind of app'}"
            elif asked["panels"] is None:
                named.pop(name, None)
                current, said = "", f"layout {name[:MAX_NAME]!r} is forgotten"
            else:
                named[_name(name)] = _panels(asked["panels"])
                if len(named) > MAX_LAYOUTS:
                    raise LocalError(f"layout: {MAX_LAYOUTS} are kept at most; forget one first")
                current, said = name, f"layout {name!r} is kept in {self._path}"
            self._write({"current": current, "layouts": named})
            self.current, self.named = current, named
        return said

    def _read(self) -> None:
        # A file that cannot be read, or that somebody has written by hand, costs no more than the layouts in it.
        with contextlib.suppress(OSError, ValueError, LocalError, TypeError, KeyError, AttributeError, RecursionError):
            kept = json.loads(self._path.read_text(encoding="utf-8"))
            self.named = {_name(name): _panels(panels) for name, panels in kept["layouts"].items()}
            self.current = kept["current"] if kept["current"] in self.named else ""

    def _write(self, kept: dict[str, Any]) -> None:
        try:
            make_folder(self._path.parent)
            atomic_write(self._path, json.dumps(kept, indent=1).encode())
        except OSError as error:
            raise LocalError(f"{self._path}: {error.strerror}: the layout is not kept") from None


def _name(name: str) -> str:
    if not 0 < len(name) <= MAX_NAME or not name.isprintable():
        raise LocalError(f"layout: a name has 1 to {MAX_NAME} printable characters")
    return name


def _panels(panels: Any) -> list[Panel]:
    if not isinstance(panels, list) or not 0 < len(panels) <= MAX_PANELS:
        raise LocalError(f"layout: expected 1 to {MAX_PANELS} panels")
    found = []
    for each in panels:
        if not (isinstance(each, list) and len(each) == 3 and isinstance(each[0], str) and each[0].isidentifier()):
            raise LocalError("layout: a panel is [NAME, COLUMNS, ROWS]")
        if not all(type(span) is int and 1 <= span <= MAX_SPAN for span in each[1:]):
            raise LocalError(f"layout: a panel spans 1 to {MAX_SPAN} columns and rows")
        found.append((each[0][:MAX_NAME], each[1], each[2]))
    return found
