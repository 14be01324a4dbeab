"""The answers to a page's questions about recordings: one instant, numbers over the whole time, another run beside
it."""

import contextlib
from pathlib import Path
from typing import Any

from laptop.view import series
from laptop.view.layouts import Layouts
from laptop.view.recording import ViewedRecording
from laptop.view.scene import fixed_parts
from swarm.errors import LocalError, RecordingError, SwarmError
from swarm.messages.json_values import is_number
from swarm.recording import folder
from swarm.recording.reader import SUFFIX

MAX_RUNS = 200
"""The most recordings of a folder that are listed. They are the newest ones."""

EXPECTED = (
    "expected {seek: {since, t}}, {series: {topic, fields}}, {runs}, {open: RUN}, {beside: RUN or null} or "
    "{layout: {name, panels}}"
)


class Playing:
    """One page's way through recordings."""

    def __init__(self, recording: ViewedRecording, layouts: Layouts, wanted: str | None) -> None:
        """`wanted`: the name of another recording of the same folder, with which the page begins where it is there."""
        self._recording = recording
        self._folder = recording.path.resolve().parent
        self._layouts = layouts
        self._beside: ViewedRecording | None = None
        if wanted not in (None, recording.path.resolve().name):
            with contextlib.suppress(SwarmError):
                self._recording = self._load(wanted)

    def first(self) -> dict[str, Any]:
        """Return the message that a page gets before it asks."""
        run = self._recording
        swarm = fixed_parts(run, None) or {"kind": run.kind, "robots": list(run.robots), "edges": [], "acts": []}
        told = {"first": run.first, "last": run.last, "damage": run.damage, "name": run.path.resolve().name}
        return {
            "t": run.first,
            "live": True,
            "swarm": swarm | {"recording": told, "parameters": run.parameters()},
            "marks": run.marks(),
            "layouts": self._layouts.told(),
        }

    def answer(self, asked: Any) -> dict[str, Any]:
        """Answer one question."""
        try:
            if "seek" in asked:
                since = asked["seek"].get("since")
                return self._step(None if since is None else number_asked(since), number_asked(asked["seek"]["t"]))
            if "series" in asked:
                topic, fields = series.wanted(asked["series"])
                answer: dict[str, Any] = {"topic": topic, "fields": fields}
                answer["rows"] = self._recording.series(topic, fields)
                if self._beside is not None:
                    answer["beside"] = self._beside.series(topic, fields)
                return {"series": answer}
            if "runs" in asked:
                return {"runs": runs_in(self._folder)}
            if "open" in asked:
                self._recording, self._beside = self._load(asked["open"]), None
                return self.first()
            if "beside" in asked:
                return {"beside": self._put_beside(asked["beside"])}
            if "layout" in asked:
                return {"done": self._layouts.keep(asked["layout"]), "layouts": self._layouts.told()}
        except LocalError as error:
            return {"refused": str(error)}
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
            pass
        return {"refused": EXPECTED}

    def _step(self, since: float | None, t: float) -> dict[str, Any]:
        step = self._recording.step(since, t)
        if self._beside is not None:
            step["beside_places"] = self._beside.places(t)
        return step

    def _put_beside(self, name: object) -> dict[str, Any] | None:
        if name is None:
            self._beside = None
            return None
        self._beside = run = self._load(name)
        return {
            "name": run.path.name,
            "first": run.first,
            "last": run.last,
            "robots": list(run.robots),
            "parameters": run.parameters(),
        }

    def _load(self, name: object) -> ViewedRecording:
        """Load one of the recordings that are listed, and no other file of this machine."""
        if str(name) not in {each["name"] for each in runs_in(self._folder)}:
            raise RecordingError(f"{self._folder}: there is no recording {str(name)[:60]!r}")
        return ViewedRecording(self._folder / str(name))


def runs_in(directory: Path) -> list[dict[str, Any]]:
    """Return the recordings in a folder, each a folder or a file of its own, the newest first."""
    found: list[dict[str, Any]] = []
    for path in directory.iterdir():
        try:
            files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path] if path.suffix == SUFFIX else []
            if files:
                stats = [file.stat() for file in files]
                size, at = sum(each.st_size for each in stats), max(each.st_mtime for each in stats)
                app = folder.read_run(path).get("app", "") if path.is_dir() else ""
                found.append({"name": path.name, "app": str(app), "at": at, "size": size})
        except (OSError, RecordingError):
            continue
    return sorted(found, key=lambda each: -each["at"])[:MAX_RUNS]


def number_asked(value: object) -> float:
    """Return a number that a page has sent. Raises `TypeError` for other values."""
    if not is_number(value):
        raise TypeError("no number")
    return float(value)
