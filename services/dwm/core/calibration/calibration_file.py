"""The file that holds one robot's calibration: written by `swarm calibrate`, read by the service at its start.

TOML, so that a person can read and compare it. It says for which robot and which layout of anchors it is: a place's
model holds for the anchors it was measured with, and so do most errors of a range.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from services.dwm.core.calibration.models import Calibration, RangeModel
from swarm.config.reader import Table, finite, vector
from swarm.config.toml_input import read_toml
from swarm.config.types import Affine, Anchor
from swarm.errors import ConfigError, PayloadError
from swarm.frozen import frozen

_SHOWN = 16
"""Hex digits of a layout's hash: 64 bits are enough to tell two layouts apart."""

_HEADER = """\
# Calibration of a robot's UWB module, made by `swarm calibrate` (docs/how-to/robots/calibrate.md). Lengths in m;
# `left_out` and `nested` are rms errors at places that were left out of the fit, `residuals` [true distance, error] or
# [x, y, error].
"""


@frozen
class Evidence:
    """The samples from which a model was made, and its accuracy."""

    model: str
    """Name of the model."""
    made: str
    """Date and time of the calibration: UTC, ISO 8601."""
    places: int
    samples: int
    sha256: str
    """SHA-256 of the samples."""
    left_out: Mapping[str, float]
    nested: float
    residuals: tuple[tuple[float, ...], ...]
    offsets: tuple[str, ...] = ()
    """SHA-256 of the samples or reports whose offsets were added to the robot's own, in a model of ranges."""


@frozen
class CalibrationFile:
    """One robot's calibration; a part that was not done is None."""

    robot: str
    layout: str
    """Hash of the anchors with which the calibration was made (`layout_of`)."""
    anchors: tuple[str, ...]
    """The anchors as text for people: `D001 (0, 0, 0)`."""
    distance: tuple[RangeModel, Evidence] | None = None
    position: tuple[Affine, Evidence] | None = None

    def over(self, normal: Calibration) -> Calibration:
        """Return the calibration in use: `normal` where this file has no model."""
        ranges = self.distance[0] if self.distance else normal.ranges
        return Calibration(ranges, self.position[0] if self.position else normal.position)

    def with_parts(self, other: "CalibrationFile") -> "CalibrationFile":
        """This file with the parts that `other` has in place of its own."""
        return replace(self, distance=other.distance or self.distance, position=other.position or self.position)


def layout_of(anchors: Sequence[Anchor]) -> str:
    """Return a hash of addresses and places (to the mm), whatever their order."""
    lines = sorted(f"{a.address} {_mm(a.x)} {_mm(a.y)} {_mm(a.z)}" for a in anchors)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:_SHOWN]


def described(anchors: Sequence[Anchor]) -> tuple[str, ...]:
    """Return the anchors for people."""
    return tuple(f"{a.address} ({a.x:g}, {a.y:g}, {a.z:g})" for a in sorted(anchors, key=lambda a: a.address))


def check(file: CalibrationFile, path: str, robot: str, anchors: Sequence[Anchor]) -> None:
    """Raises `ConfigError` where the file is another robot's, or the anchors stand elsewhere now."""
    if file.robot != robot:
        raise ConfigError(f"{path}: is the calibration of {file.robot}, this is {robot}; [dwm] calibration names it")
    if file.layout != layout_of(anchors):
        now = ", ".join(described(anchors)) or "none"
        raise ConfigError(
            f"{path}: was made with other anchors ({', '.join(file.anchors) or 'none'}; now: {now}). Put the anchors "
            f"or [[anchors]] back, or calibrate anew: swarm calibrate position --robots {robot}"
        )


def parse(text: str, path: str) -> CalibrationFile:
    """Return the file with that text; raises `ConfigError` naming path, table and entry."""
    try:
        data = read_toml(text)
    except PayloadError as error:
        raise ConfigError(f"{path}: {error}") from None
    top = Table(path, "", data, ("robot", "layout", "anchors", "distance", "position"))
    anchors = data.get("anchors", [])
    if not isinstance(anchors, list) or not all(isinstance(item, str) for item in anchors):
        raise top.wrong("anchors", "a list of texts")
    return CalibrationFile(
        robot=top.text("robot"),
        layout=top.text("layout"),
        anchors=tuple(anchors),
        distance=_distance(top) if "distance" in top else None,
        position=_position(top) if "position" in top else None,
    )


def text_of(file: CalibrationFile) -> str:
    """Return the text that `parse` reads as `file`."""
    lines = [_HEADER.rstrip(), f"robot = {_toml(file.robot)}", f"layout = {_toml(file.layout)}"]
    lines.append(f"anchors = {_toml(file.anchors)}")
    if file.distance is not None:
        model, evidence = file.distance
        entries = {name: getattr(model, name) for name in ("gain", "offset", "log", "low", "robot", "antenna")}
        entries["offsets"] = evidence.offsets
        lines += ["", "[distance]", *_lines(entries), *_evidence_lines(evidence)]
    if file.position is not None:
        place, evidence = file.position
        entries = {"matrix": place.matrix, "offset": place.offset}
        lines += ["", "[position]", *_lines(entries), *_evidence_lines(evidence)]
    return "\n".join(lines) + "\n"


_EVIDENCE = ("model", "made", "places", "samples", "sha256", "left_out", "nested", "residuals")


def _distance(top: Table) -> tuple[RangeModel, Evidence]:
    table = top.table("distance", ("gain", "offset", "log", "low", "robot", "antenna", "offsets", *_EVIDENCE))
    log = table.number("log", 0.0)
    model = RangeModel(
        gain=table.number("gain", above=0, expected="a number above 0"),
        offset=table.number("offset"),
        log=log,
        low=table.number("low", 0.0, above=0 if log else -1e9, expected="a number above 0, as log is not 0"),
        robot=table.number("robot", 0.0),
        antenna=table.numbers("antenna", (0.0, 0.0), expected="two numbers", length=2),
    )
    offsets = table.data.get("offsets", [])
    if not isinstance(offsets, list) or not all(isinstance(item, str) for item in offsets):
        raise table.wrong("offsets", "a list of texts")
    return model, replace(_evidence(table, 2), offsets=tuple(offsets))


def _position(top: Table) -> tuple[Affine, Evidence]:
    table = top.table("position", ("matrix", "offset", *_EVIDENCE))
    rows = _rows(table, "matrix", 2, "two rows of two numbers, [[a, b], [c, d]]")
    if len(rows) != 2:
        raise table.wrong("matrix", "two rows of two numbers, [[a, b], [c, d]]")
    offset = table.numbers("offset", (0.0, 0.0), expected="two numbers [x, y], in m", length=2)
    (a, b), (c, d) = rows
    return Affine(((a, b), (c, d)), offset), _evidence(table, 3)


def _evidence(table: Table, columns: int) -> Evidence:
    made = table.data.get("made")
    if not isinstance(made, datetime):
        raise table.wrong("made", "a date and time")
    left_out = table.table("left_out", None)
    errors = {name: finite(value) for name, value in left_out.data.items()}
    if None in errors.values():
        raise table.wrong("left_out", "numbers by the names of models")
    return Evidence(
        model=table.text("model"),
        made=made.isoformat(),
        places=table.count("places", 0, low=0),
        samples=table.count("samples", 0, low=0),
        sha256=table.text("sha256"),
        left_out={name: value for name, value in errors.items() if value is not None},
        nested=table.number("nested"),
        residuals=_rows(table, "residuals", columns, f"a list of lists of {columns} numbers"),
    )


def _rows(table: Table, key: str, columns: int, expected: str) -> tuple[tuple[float, ...], ...]:
    value = table.data.get(key)
    rows = [vector(row) for row in value] if isinstance(value, list) else [None]
    if not all(row is not None and len(row) == columns for row in rows):
        raise table.wrong(key, expected)
    return tuple(row for row in rows if row is not None)


def _evidence_lines(evidence: Evidence) -> list[str]:
    entries = {name: getattr(evidence, name) for name in _EVIDENCE if name not in ("made", "left_out")}
    finite_errors = {name: value for name, value in evidence.left_out.items() if finite(value) is not None}
    inner = ", ".join(f"{_toml(name)} = {_toml(value)}" for name, value in finite_errors.items())
    return [f"made = {evidence.made}", *_lines(entries), f"left_out = {{ {inner} }}"]


def _lines(entries: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {_toml(value)}" for name, value in entries.items()]


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value)  # a TOML basic string for any text without control characters
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value) if isinstance(value, float) else str(value)


def _mm(value: float) -> int:
    return round(value * 1000)
