"""`swarm check FILE`: what an app declares and costs, and how it behaves, before any robot moves.

Two processes that hash differently rehearse it on standard graphs; here their findings are compared and told.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from services.apps.loader import BUILT_IN
from swarm.errors import PayloadError
from swarm.messages.json_input import read_json
from swarm.process.arguments import add_json, whole
from swarm.process.terminal import columns

PI_FACTOR = 10.0
"""A Pi Zero 2 W (Cortex-A53, 1 GHz) runs plain Python about this much slower than a laptop [estimated: 8 to 15]."""

STEP_BUDGET = 0.010
"""Longest step on a Pi, s: a third of a message's time over Bluetooth, so that steps do not set the lockstep's pace."""

PATIENCE = 180.0
"""Seconds after which a rehearsal is ended from outside: it hangs where Python cannot be interrupted. Each of the five
graphs ends by itself after 20 s."""

SEEDS = ("1", "2")
"""Seeds of Python's hashing, one for each process: sets and dicts of text come in another order."""

HELP = "check an app before any robot moves: its messages, the time of a step, five graphs"

Json = dict[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the app, and how it is rehearsed."""
    parser.add_argument("app", metavar="APP", help=f"a file with an app, or {', '.join(BUILT_IN)}")
    parser.add_argument("--robots", type=whole(1), default=6, metavar="N", help="robots in the rehearsal (6)")
    parser.add_argument("--iterations", type=whole(4), default=300, metavar="K", help="iterations on each graph (300)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="[ROBOT.]NAME=VALUE",
        help="a parameter or first value, for all robots or for one",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Return exit code 0 if nothing is wrong with the app, 1 if something is; the code is 2 if it cannot be
    examined."""
    with ThreadPoolExecutor() as both:
        found = judge(*both.map(partial(_rehearse, args), SEEDS))
    sys.stdout.write(json.dumps(found) + "\n" if args.json else text(found))
    return 0 if found["ok"] else 1


def judge(one: list[Json], other: list[Json]) -> Json:
    """Judge two rehearsals together: `problems` say what, where and in which line."""
    app: Json = one[0] if one and "app" in one[0] else {}
    graphs = [entry for entry in one if "graph" in entry]
    again = {entry["graph"]: entry for entry in other if "graph" in entry}
    source = app.get("source", "")
    problems: list[str] = []
    for entry in [entry for entry in (*one, *other) if entry.get("fault")]:
        place = f" ({source}, line {entry['line']})" if entry.get("line") else ""
        # The same fault on another graph says nothing new.
        if not any(_kind(entry["fault"]) == _kind(known) for known in problems):
            problems.append(f"{entry['fault']}{place}")
    if not graphs and not problems:
        problems.append("nothing of it was run")
    for entry in graphs:
        if entry["trend"].get("grows"):
            problems.append(f"it diverges on graph {entry['graph']}: the results grow without end ({_step(app)})")
            break
    for entry in graphs:
        differs = _first_difference(entry["digests"], again.get(entry["graph"], entry)["digests"])
        if differs is not None and not entry["fault"]:
            problems.append(
                f"graph {entry['graph']}, iteration {differs}: two processes came to different states: something goes "
                f"by the order of a set, by the time or by a random number that is not robot.random ({_step(app)})"
            )
            break
    # The quicker of two: what the machine did besides is no cost of the app.
    steps = [min(entry["step_mean"], again.get(entry["graph"], entry)["step_mean"]) for entry in graphs]
    mean = max(steps, default=0.0)
    warnings = sorted({warning for entry in (app, *graphs) for warning in entry.get("warnings", ())})
    if mean * PI_FACTOR > STEP_BUDGET:
        warnings.append(
            f"a step takes about {1e3 * PI_FACTOR * mean:.1f} ms on a Pi Zero 2 W, more than {1e3 * STEP_BUDGET:g} ms"
        )
    for entry in graphs:
        entry.pop("digests")
    return {
        **app,
        "step_s": mean,
        "step_pi_s": PI_FACTOR * mean,
        "pi_factor": PI_FACTOR,
        "graphs": graphs,
        "warnings": warnings,
        "problems": problems,
        "ok": not problems,
    }


def text(found: Mapping[str, Any]) -> str:
    """Return the findings as text for people."""
    lines = []
    if "app" in found:
        here, there = 1e6 * found["step_s"], 1e3 * found["step_pi_s"]
        fields = ", ".join(f"{name} {kind}" for name, kind in found["fields"].items()) or "none"
        algorithms = f", algorithms {', '.join(found['algorithms'])}" if found["algorithms"] else ""
        lines += [
            f"app         {found['app']}: {found['class']}, {found['kind']}{algorithms}",
            f"state       {found['bytes']} bytes ({fields}), {found['bytes_on_air']} with the frame around them",
        ]
        ran = [entry for entry in found["graphs"] if entry["iterations"]]
        if found["step_s"]:
            lines += [
                f"step        {here:.0f} us here, about {there:.1f} ms on a Pi Zero 2 W, by an estimated factor of "
                f"{found['pi_factor']:g}"
            ]
        if ran:
            rows = [["graph", "iterations", "settles at", "spread at the end"]]
            rows += [[entry["graph"], str(entry["iterations"]), *_trend(entry["trend"])] for entry in ran]
            lines += ["", *columns(rows)]
        lines += ["", f"ran         {_ran(found)}"]
    lines += [f"warning     {warning}" for warning in found["warnings"]]
    lines += [f"problem     {problem}" for problem in found["problems"]]
    if found["ok"]:
        lines.append("ok          same step, same result; in two processes too")
    return "\n".join(lines) + "\n"


def _trend(trend: Mapping[str, Any]) -> tuple[str, str]:
    """Return when the results settle, and how far the robots differ at the end, each with the result that it is of."""
    if trend.get("spread") is None:
        return "-", "-"
    settles = "diverges" if trend["grows"] else "-" if trend["settles"] is None else trend["settles"]
    return f"{settles} ({trend['slowest']})", f"{trend['spread']:.3g} ({trend['widest']})"


def _ran(found: Mapping[str, Any]) -> str:
    """Return in words what the rehearsal has given the app, on each graph at least."""
    graphs = found["graphs"]
    if not graphs:
        return "nothing"
    steps = {"sync": "iterations", "periodic": "steps", "event": "events"}[found["kind"]]
    seconds, count = (min(entry[name] for entry in graphs) for name in ("seconds", "iterations"))
    had = [f"{what}: {min(entry[what] for entry in graphs)}" for what in ("poses", "ranges")]  # no comes before yes
    return ", ".join((f"{seconds:.4g} s", f"{count} {steps}", *had))


def _rehearse(options: argparse.Namespace, seed: str) -> list[Json]:
    command = [sys.executable, "-P", "-m", "sim.rehearsal.examine", options.app]
    command += ["--robots", str(options.robots), "--iterations", str(options.iterations)]
    for setting in options.set:
        command += ["--set", setting]
    environment = {**os.environ, "PYTHONHASHSEED": seed}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment, text=True) as child:
        try:
            output, errors = child.communicate(timeout=PATIENCE)
            ended = f"the app's process ended with code {child.returncode}"
        except subprocess.TimeoutExpired:
            child.kill()
            output, errors = child.communicate()
            ended = (
                f"the rehearsal was not over after {PATIENCE:g} s and was ended: likely the app hangs where Python "
                "cannot be interrupted"
            )
    found = []
    for line in output.splitlines():
        with contextlib.suppress(PayloadError):  # it was ended within a line
            entry = read_json(line)
            if isinstance(entry, dict):
                found.append(entry)
    if child.returncode != 0:
        last = f"; the last line it wrote: {errors.strip().splitlines()[-1]}" if errors.strip() else ""
        found.append({"fault": f"{options.app}: {ended}{last}", "line": None})
    return found


def _kind(fault: str) -> str:
    """Return a fault without robot and iteration."""
    return fault.rpartition(": ")[2].partition(" (")[0]


def _step(app: Json) -> str:
    return f"{app.get('source', '')}, line {app.get('step_line', 1)}"


def _first_difference(one: list[int], other: list[int]) -> int | None:
    """Return the first index at which two histories differ, up to the end of the shorter one."""
    return next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), None)
