"""Tables of the messages that a run has recorded under a topic, on the run's time axis; as CSV, npz, mat or parquet."""

import importlib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from swarm.core.state import names_of
from swarm.errors import LocalError, MissingPackageError, RecordingError
from swarm.recording.run import Run

FORMATS = ("csv", "npz", "mat", "parquet")

Table = dict[str, list[Any]]
"""Columns by name, all of the same length; None marks a row without a value."""

_LONGEST_VARIABLE = 63

_EXTRA = {"npz": ("numpy", "lab"), "mat": ("scipy", "tables"), "parquet": ("pyarrow", "tables")}
"""The package that each format needs, and the extra that installs it."""


def of_topic(recorded: Run, topic: str) -> Table:
    """Return all messages of a topic below the robots' names, such as `balancer/state`: a row each, with `t` (s,
    common to all robots, 0 = the first state), `robot` and the message's fields. Raises `RecordingError` where there
    are none."""
    known = {"/".join(name.split("/")[2:]) for name in recorded.topics}
    if topic not in known:
        raise RecordingError(f"{recorded.path}: no topic {topic} is recorded; there are: {', '.join(sorted(known))}")
    rows = []
    for sample in recorded.samples(f"swarm/*/{topic}"):
        fields = _flat("", {name: value for name, value in sample.message.items() if name != "t"}, recorded.shapes)
        rows.append({"t": sample.t, "robot": sample.topic.split("/")[1], **fields})
    return {name: [row.get(name) for row in rows] for name in dict.fromkeys(name for row in rows for name in row)}


def require(kind: str) -> None:
    """Raise `MissingPackageError` where a format needs a package that is not installed."""
    if kind not in _EXTRA:
        return
    needed, extra = _EXTRA[kind]
    try:
        importlib.import_module(needed)
    except ImportError:
        raise MissingPackageError(f"--format {kind}", needed, extra) from None


def write(path: Path, table: Table) -> None:
    """Write a table into a new file, in the format that its ending names, whose package is installed (`require`).
    Raises `LocalError` where the file is there."""
    kind = path.suffix.removeprefix(".")
    if kind not in FORMATS:
        raise LocalError(f"{path}: tables are written as {', '.join(FORMATS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        raise LocalError(f"{path}: it is there already; name a new folder")
    _WRITERS[kind](path, table)


def _flat(name: str, value: Any, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """Return the fields of a message by dotted names. Parts of a list are called by what names them, links by their
    peer, or by their number; entries of a matrix of one of the `shapes` by row and column."""
    if isinstance(value, Mapping):
        parts = {f"{name}.{key}" if name else str(key): part for key, part in value.items()}
    elif isinstance(value, list | tuple):
        called = [part.get("peer", part.get("robot")) if isinstance(part, Mapping) else None for part in value]
        names = names_of(name, len(value), shapes.get(name.rpartition(".")[2], ()))
        parts = {f"{name}.{it}" if it else number: part for it, number, part in zip(called, names, value, strict=True)}
    else:
        return {name: value}
    return {inner: found for each, part in parts.items() for inner, found in _flat(each, part, shapes).items()}


def _csv(path: Path, table: Table) -> None:
    lines = [",".join(map(_cell, table)), *(",".join(map(_cell, row)) for row in zip(*table.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n", newline="")


def _cell(value: object) -> str:
    text = "" if value is None else value if isinstance(value, str) else repr(value)
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\n\r') else text


def _npz(path: Path, table: Table) -> None:
    import numpy as np

    columns: dict[str, Any] = {name: np.array(_even(values)) for name, values in table.items()}
    np.savez_compressed(path, **columns)


def _mat(path: Path, table: Table) -> None:
    import numpy as np
    from scipy.io import savemat

    columns = {name: np.array(_even(values)) for name, values in zip(_variables(table), table.values(), strict=True)}
    savemat(path, columns, long_field_names=True, oned_as="column")


def _variables(names: Iterable[str]) -> list[str]:
    """Return MATLAB's names for columns: letters, digits and _, a letter first, at most 63, no two alike."""
    found: list[str] = []
    for name in names:
        plain = "".join(each if each.isascii() and each.isalnum() else "_" for each in name).strip("_")
        plain = (plain if plain[:1].isalpha() else f"x{plain}")[:_LONGEST_VARIABLE]
        number = 1
        while (unique := plain if number == 1 else f"{plain[: _LONGEST_VARIABLE - 4]}_{number}") in found:
            number += 1
        found.append(unique)
    return found


def _parquet(path: Path, table: Table) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table({name: _even(values) for name, values in table.items()}), path)


def _even(values: list[Any]) -> list[Any]:
    """Return values of one type: truths and integers of 64 bits as they are, other numbers with nan where there is
    none, all else as text."""
    there = [value for value in values if value is not None]
    whole = all(type(value) is int and -(2**63) <= value < 2**63 for value in there)
    if len(there) == len(values) and (whole or all(isinstance(value, bool) for value in there)):
        return values
    if all(isinstance(value, int | float) for value in there):
        return [math.nan if value is None else float(value) for value in values]
    return ["" if value is None else str(value) for value in values]


_WRITERS = {"csv": _csv, "npz": _npz, "mat": _mat, "parquet": _parquet}
