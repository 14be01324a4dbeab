"""The results of a run as a table and some sentences, for people."""

import math
from collections.abc import Sequence

from sim import scene
from sim.report import Json, RunOutcome, estimate, is_consensus, is_metric, result
from swarm.process.terminal import columns
from swarm.recording import trajectory
from swarm.recording.trajectory import Trajectory

MOST_ENTRIES = 4
"""Entries up to which a vector stands in the table."""
MOST_ROWS = 50
"""Robots that the table shows."""


def table(report: Json, outcome: RunOutcome) -> str:
    """Return the report as text for people."""
    rows = [("robot", "iterations", *_headings(outcome), "restarts")]
    names = outcome.scenario.config.names
    for name in names[:MOST_ROWS]:
        path = outcome.trajectories.get(name, trajectory.EMPTY)
        rows.append((name, str(max(path.last, 0)), *_cells(outcome, name), str(outcome.restarts[name])))
    lines = columns(rows, right=True, rule=True)
    for app, others in outcome.beside.items():
        rows = [("robot", "iterations", f"result of {app}, which ran beside")]
        rows += [(name, str(max(others[name].last, 0)), _results(others[name])) for name in names[:MOST_ROWS]]
        lines += ["", *columns(rows, right=True, rule=True)]
    if len(names) > MOST_ROWS:
        lines.append(f"... and {len(names) - MOST_ROWS} robots more (--json has all)")
    return "\n".join([*lines, "", *_sentences(report, outcome)])


def _results(path: Trajectory) -> str:
    """Results in one cell, of the last iteration: errors first, a vector under one name, of a long one its length."""
    vectors: dict[str, list[object]] = {}
    for name, value in (result(path) or {}).items():
        vectors.setdefault(name.partition("[")[0], []).append(value)
    names = sorted(vectors, key=lambda name: not is_metric(f"result.{name}"))
    return (
        ", ".join(f"{name}={_cell(vectors[name], vector=f'result.{name}' not in path.columns)}" for name in names)
        or "-"
    )


def _cell(values: Sequence[object], *, vector: bool) -> str:
    if not vector:
        return _short(values[0])
    return f"[{', '.join(map(_short, values))}]" if len(values) <= MOST_ENTRIES else f"[{len(values)} numbers]"


def _headings(outcome: RunOutcome) -> tuple[str, ...]:
    if outcome.scenario.built_in == "localization":
        return ("target x m", "target y m", "error cm")
    return ("result",) if outcome.scenario.app else ("mode", "tilt deg")


def _cells(outcome: RunOutcome, name: str) -> tuple[str, ...]:
    path = outcome.trajectories.get(name, trajectory.EMPTY)
    if outcome.scenario.built_in == "localization":
        x, y = estimate(path)
        target = outcome.targets().get(name, outcome.scenario.config.simulation.target)
        return (
            f"{x:.4f}",
            f"{y:.4f}",
            f"{100 * math.dist((x, y), target):.2f}",
        )
    if outcome.scenario.app:
        return (_results(path),)
    body = outcome.bodies.get(name)
    return ("-", "-") if body is None else (body.fault or body.mode, f"{math.degrees(body.tilt):.1f}")


def _sentences(report: Json, outcome: RunOutcome) -> list[str]:
    lines = []
    median, p95 = report["iteration_s_median"], report["iteration_s_p95"]
    if isinstance(median, float) and isinstance(p95, float):
        lines.append(f"iteration   {1e3 * median:.1f} ms median, {1e3 * p95:.1f} ms 95 %")
    if report["messages_per_iteration"] is not None:
        lines.append(f"messages    {report['messages_per_iteration']} an iteration")
    elif report["messages"]:
        lines.append(f"messages    {report['messages']} states and acknowledgements between the robots")
    if outcome.started_s is not None:
        ready = "the first iteration" if outcome.scenario.app else "all services ready"
        lines.append(f"start       {outcome.started_s:.2f} s from the command to {ready}")
    if outcome.computed_s is not None:
        lines.append(f"virtual     {outcome.seconds:.2f} s of the robots' time in {outcome.computed_s:.2f} s")
    if late := outcome.radio:
        stood = f"; it stood still for {late['stood_still_s']:g} s" if late["stood_still_s"] else ""
        lines.append(
            f"radio       {1e3 * late['late_mean_s']:.1f} ms late on average, {1e3 * late['late_most_s']:.1f} ms at "
            f"most, with {late['frames']} frames{stood}"
        )
    if report["rss_mib_per_robot"] is not None:
        lines.append(
            f"memory      {report['rss_mib_per_robot']} MiB resident a robot (shared pages counted in each process)"
        )
    if is_consensus(outcome.scenario):
        lines.append(f"error       {_short(report['error'])} from the mean {_short(report['mean'])}")
    else:
        lines += [
            f"{name:<11} {_short(report[name])} mean of the robots, {_short(report[f'{name}_most'])} at most"
            for name in report
            if f"{name}_most" in report
        ]
    if outcome.scenario.built_in == "localization":
        recorded = f" (recorded: {_short(report['recorded_error_cm'])} cm)" if outcome.scenario.recorded else ""
        lines.append(f"error       {_short(report['error_cm'])} cm mean distance to the true target{recorded}")
    if "replay_deviation_cm" in report:
        of = "trajectory at most" if outcome.scenario.algorithm == "thesis" else "last estimates at most"
        lines.append(f"deviation   {_short(report['replay_deviation_cm'])} cm from the recorded {of}")
        early = report["early_ends"]
        assert isinstance(early, list)
        lines += [f"early end   {each}" for each in early]
    if outcome.missing:
        lines.append(f"missing     {', '.join(outcome.missing)}: the others have gone on without")
    lines += [f"never       {each}" for each in outcome.never]
    lines += scene.sentences(outcome.scene)
    problems = report["problems"]
    assert isinstance(problems, list)
    lines += [f"problem     {problem}" for problem in problems]
    return lines


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "-" if value is None else str(value)
