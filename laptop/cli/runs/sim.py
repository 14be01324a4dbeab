"""`swarm sim`: a simulated swarm of real service processes in one world."""

import contextlib
import errno
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TextIO

from sim import report, report_table
from sim.processes.progress import say
from sim.scenario import options as arguments
from sim.scenario import scenario
from sim.scenario.command import keep_command
from sim.scenario.options import Options
from sim.scenario.scenario import Scenario
from swarm.errors import LocalError
from swarm.process import log, service
from swarm.process.arguments import json_alone
from swarm.process.simulations import claim, default_run_dir
from swarm.recording import folder


def main() -> int:
    """Run one simulation; the exit code is 0 only when it did what was asked, 130 after Ctrl-C."""
    log.setup("sim")
    return run_simulation(arguments.parse(sys.argv[1:]), sys.argv[1:])


def run_simulation(options: Options, words: Sequence[str]) -> int:
    """Run one simulation with these options, and keep `words`, from which they were read, in its recording; returns the
    exit code."""
    with json_alone(options.json) as out:
        return _simulated(options, words, out)


def _simulated(options: Options, words: Sequence[str], out: TextIO) -> int:
    if options.virtual:
        with tempfile.TemporaryDirectory(prefix="swarm-sim-") as place:
            # What is drawn is what was recorded.
            keeps = options.record is None and options.plot is not None
            return _virtual(replace(options, record=Path(place) / "run") if keeps else options, words, out)
    run_dir = (options.run_dir or default_run_dir()).absolute()
    with claim(run_dir):
        try:
            return _run(options, run_dir, words, out)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise LocalError(f"the disk is full: {error.filename or run_dir}") from None
            raise
        finally:
            _clear(run_dir)


def _virtual(options: Options, words: Sequence[str], out: TextIO) -> int:
    from sim.virtual import run as virtual  # most of the services: a quarter of what a simulation imports

    if options.record is not None:
        folder.make_empty(options.record)
    plan = scenario.build(options, virtual.PLACE)
    if options.record is not None:  # a command that is refused leaves the folder free
        keep_command(options.record, words)
    for note in plan.notes:
        sys.stderr.write(note + "\n")
    run = virtual.VirtualRun(options, plan, said=partial(say, sys.stderr))
    tell = partial(_tell, options, plan, options.record or Path(), out)
    if options.view:
        from laptop.view import virtual_page  # the server is heavy, and of the extra `lab`

        return virtual_page.watched(run, plan, options, tell)
    return tell(run.go())


def _run(options: Options, run_dir: Path, words: Sequence[str], out: TextIO) -> int:
    _clear(run_dir)
    plan, records = scenario.build(options, run_dir), options.record or run_dir / "records"
    from sim.processes.run import ProcessRun  # virtual time runs where processes cannot: on Windows

    with ProcessRun(options, plan, run_dir, sys.stderr) as run:
        keep_command(records, words)
        outcome = run.watch()
    folder.keep_outcome(records, report.notes(outcome))
    return _tell(options, plan, records, out, outcome)


def _tell(options: Options, plan: Scenario, records: Path, out: TextIO, outcome: report.RunOutcome) -> int:
    found = report.summary(outcome)
    out.write(f"{json.dumps(found) if options.json else report_table.table(found, outcome)}\n")
    if options.plot is not None and plan.app is not None:
        what = str(options.plot)
        if any(path.last >= 0 for path in outcome.trajectories.values()):
            from laptop.cli.runs import plot  # matplotlib's helpers are wanted here alone

            references = {name: recorded.estimates for name, recorded in plan.recorded.items()}
            plot.draw(records, plan.app, options.plot, references)
        else:
            what = "none: no robot has recorded a state"
        if not options.json:
            out.write(f"plot        {what}\n")
    if found["problems"]:
        return 1
    return 128 + outcome.ended_by if outcome.ended_by else 0


def _clear(run_dir: Path) -> None:
    """Remove what a run leaves (or one killed by -9 has left) in its directory, but for the lock we hold."""
    for entry in run_dir.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        elif entry.name != "sim.lock":
            with contextlib.suppress(FileNotFoundError):
                entry.unlink()


if __name__ == "__main__":
    service.run(main)
