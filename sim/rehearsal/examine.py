"""The examination of an app for `swarm check`, in a process of its own, since the app may hang, or hash differently.

    python -m sim.rehearsal.examine FILE --robots 6 --iterations 300

It prints one JSON object a line: what the app declares, then what came of each graph.
"""

import argparse
import json
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TextIO

from services.apps import loader
from sim.rehearsal import tracing
from sim.rehearsal.examine_events import examine_events
from sim.rehearsal.examine_report import GraphFinding, Task
from sim.rehearsal.examine_sync import examine_sync
from sim.rehearsal.limits import ALARMS, Hang, alarm, limited
from sim.scenario import imports
from swarm.app import settings
from swarm.app.event_app import PeriodicApp, channels_of
from swarm.app.sync_app import SyncApp
from swarm.errors import AppError, LocalError

GRAPHS = ("line", "loop", "thesis-d", "full", "random:1")
"""Standard graphs; thesis-d is one of six robots."""

FRAME = 18
"""Bytes that mesh and lockstep add to a state on an authenticated link (docs/reference/network/frames.md)."""


def main(arguments: list[str], out: TextIO) -> int:
    """Examine one app; findings go to `out`, a line each."""
    parser = argparse.ArgumentParser(prog="python -m sim.rehearsal.examine")
    parser.add_argument("file")
    parser.add_argument("--robots", type=int, default=6)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--set", action="append", default=[], metavar="[ROBOT.]NAME=VALUE")
    chosen = parser.parse_args(arguments)
    for number in ALARMS:
        signal.signal(number, alarm)
    try:
        app = limited(str(Path(chosen.file).resolve()), lambda: loader.load(chosen.file))
        task = Task(app, chosen.robots, chosen.iterations, [settings.parse(one) for one in chosen.set])
        _tell(out, describe(task))
        for finding in examine(task):
            _tell(out, vars(finding))
    except Hang as hang:
        _tell(out, {"fault": f"it hangs while it is loaded: it {hang.why}", "line": hang.line})
    except LocalError as error:
        _tell(out, {"fault": str(error), "line": None})
    return 0


def _tell(out: TextIO, what: Mapping[str, object]) -> None:
    out.write(json.dumps(what) + "\n")
    out.flush()


def describe(task: Task) -> dict[str, object]:
    """Return the declarations of the class."""
    app, kind = task.app, task.kind
    schema = kind.spec.schema
    return {
        "app": app.name,
        "class": kind.__name__,
        "kind": "sync" if issubclass(kind, SyncApp) else "periodic" if issubclass(kind, PeriodicApp) else "event",
        "algorithms": [name for name in app.algorithms if name],
        "source": app.source,
        "step_line": tracing.line_of(kind, "step" if hasattr(kind, "step") else "start"),
        "fields": {f.name: f"{f.kind}{list(f.shape) or ''}" for f in schema.fields},
        "parameters": {name: declared.default for name, declared in kind.spec.parameters.items()},
        "bytes": schema.size,
        "bytes_on_air": schema.size + FRAME if schema.fields else 0,
        "channels": sorted(channels_of(kind)),
        "warnings": [] if app.name in loader.BUILT_IN else imports.missing_imports(app.source, imports.own_packages()),
    }


def examine(task: Task) -> Iterator[GraphFinding]:
    """Rehearse the app on each of the standard graphs. The first on which it hangs or mostly waits is the last one."""
    one = examine_sync if issubclass(task.kind, SyncApp) else examine_events
    for graph in GRAPHS:
        if graph != "thesis-d" or task.robots == 6:
            finding = GraphFinding(graph)
            try:
                one(task, finding)
            except Hang as hang:
                finding.fault, finding.line, finding.last = f"it hangs: a step {hang.why}", hang.line, True
            except AppError as error:
                finding.fault = finding.fault or str(error)
            yield finding
            if finding.last:
                return


if __name__ == "__main__":
    # What the app prints, with or without an end of its line, goes elsewhere than the findings.
    with os.fdopen(os.dup(1), "w") as findings:
        os.dup2(2, 1)
        sys.exit(main(sys.argv[1:], findings))
