"""The results of a run, as one object for programs; `report_table` writes it for people."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import field

from sim.scenario.scenario import Scenario
from swarm.app.parameters import number_or_text
from swarm.core.percentile import percentile
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.messages import BalancerState
from swarm.recording import trajectory
from swarm.recording.thesis_ranges import early_ends
from swarm.recording.trajectory import Trajectory

Json = dict[str, object]

REPLAY_BOUND_CM = 0.1
"""Largest deviation of a replay from the recording, cm. The thesis' own recordings are followed to 0.001 cm."""
END_BOUND_CM = 10.0
"""Largest deviation of another algorithm's last estimates from the recorded ones, cm: 6 in the thesis' recordings."""
SETTLED_CM = 20.0
"""Largest motion of a settled estimate over its last third, cm: up to 12 in the thesis' recordings."""

TARGET_COLUMNS = ("result.x", "result.y")


@frozen
class RunOutcome:
    """The outcome of a run, when it ended."""

    scenario: Scenario
    seed: int
    started_s: float | None
    """Seconds from the command to the first iteration of all robots; None where there was none."""
    seconds: float
    """Duration of the run after that, s."""
    trajectories: Mapping[str, Trajectory]
    bodies: Mapping[str, BalancerState | None]
    messages: int | None
    """App frames the mesh sent over all links; None without a mesh that reports."""
    rss_mib: Mapping[str, float]
    """Resident memory of each robot's processes."""
    restarts: Mapping[str, int]
    """Restarts of each robot: services that were started again, and times that it was switched off and on."""
    problems: tuple[str, ...]
    missing: tuple[str, ...] = ()
    """Robots that the others have gone on without, and that are not back at the end."""
    computed_s: float | None = None
    """Seconds that a run under virtual time took to compute; None of one in real time."""
    scene: Mapping[str, object] = field(default_factory=dict)
    """Figures of what the world saw of the run (sim/scene.py)."""
    moves_from: float = math.inf
    """The time at which a target that moves began to, by the clock of the trajectories, s."""
    beside: Mapping[str, Mapping[str, Trajectory]] = field(default_factory=dict)
    """The trajectories of other apps that the robots ran meanwhile."""
    never: tuple[str, ...] = ()
    """One sentence for each disturbance that did not happen, with the reason."""
    radio: Mapping[str, float] = field(default_factory=dict)
    """The lateness of the radio process (`sim.processes.radio`), by name; empty without one."""
    ended_by: int = 0
    """Number of the signal that ended the run before its own end; 0: it came to that."""

    def target(self, t: float) -> tuple[float, float]:
        """Return the target's place at a time of the trajectories, m."""
        return self.scenario.config.simulation.target_after(t - self.moves_from)

    @property
    def members(self) -> dict[str, Trajectory]:
        """The trajectories of the robots that were in the run to its end."""
        return {name: path for name, path in self.trajectories.items() if name not in self.missing}

    def targets(self) -> dict[str, tuple[float, float]]:
        """Return the target's place at each robot's last iteration."""
        return {name: self.target(path.times[path.last]) for name, path in self.trajectories.items() if path.last >= 0}


def notes(outcome: RunOutcome) -> dict[str, str]:
    """Return the outcome's part that a recording keeps."""
    kept = {
        "problems": json.dumps(outcome.problems),
        "never": json.dumps(outcome.never),
        "scene": json.dumps(outcome.scene),
    }
    return kept if outcome.messages is None else {"messages": str(outcome.messages), **kept}


def summary(outcome: RunOutcome) -> Json:
    """Return the object of `--json`: lengths in m but for names with `_cm`, times in s."""
    scenario = outcome.scenario
    paths = outcome.trajectories
    times = trajectory.iteration_times(paths)
    members = outcome.members
    iterations = min((path.last for path in members.values()), default=0)
    memory = list(outcome.rss_mib.values())
    report: Json = {
        "app": scenario.app,
        "algorithm": scenario.algorithm,
        "robots": len(scenario.config.robots),
        "topology": scenario.topology,
        "seed": outcome.seed,
        "started_s": _rounded(outcome.started_s, 3),
        "seconds": _rounded(outcome.seconds, 3),
        "iterations": max(iterations, 0),
        "iteration_s_median": _rounded(trajectory.median(times), 6),
        "iteration_s_p95": _rounded(percentile(times, 95) if times else None, 6),
        "result": {name: result(path) for name, path in paths.items()} or bodies(outcome),
        "messages_per_iteration": (
            round(outcome.messages / iterations, 2)
            if outcome.messages is not None and iterations > 0 and scenario.steps
            else None
        ),
        "messages": outcome.messages,
        "rss_mib_per_robot": round(sum(memory) / len(memory), 1) if memory else None,
        "restarts": sum(outcome.restarts.values()),
        "problems": list(outcome.problems),
        "missing": list(outcome.missing),
        "never": list(outcome.never),
        **({"scene": dict(outcome.scene)} if outcome.scene else {}),
    }
    if outcome.radio:
        report["radio"] = dict(outcome.radio)
    if outcome.beside:
        report["beside"] = {
            app: {
                "iterations": max(min((path.last for path in others.values()), default=0), 0),
                "result": {name: result(path) for name, path in others.items()},
            }
            for app, others in outcome.beside.items()
        }
    if outcome.computed_s is not None:
        report["virtual"] = True
        report["computed_s"] = round(outcome.computed_s, 3)
    if is_consensus(scenario):
        report["mean"] = true_mean(scenario)
        report["error"] = consensus_error(scenario, members)
    report |= metrics(members)
    if scenario.built_in == "localization":
        report["error_cm"] = target_error_cm(outcome, {name: estimate(path) for name, path in paths.items()})
    if scenario.recorded:
        last = {name: rec.estimates[min(iterations, len(rec.estimates) - 1)] for name, rec in scenario.recorded.items()}
        report["recorded_error_cm"] = target_error_cm(outcome, last)
        if scenario.algorithm == "thesis":
            deviation: float | None = replay_deviation_cm(scenario, paths)
            problems = _mismatch(scenario, paths, deviation)
        else:  # it is not meant to follow the recorded one, but to end where that ended
            deviation = end_deviation_cm(scenario, paths)
            problems = _other_end(deviation)
        report["replay_deviation_cm"] = deviation
        report["problems"] = [*outcome.problems, *scenario.mismatches, *problems]
        # A run that ended before them says nothing of its files' ends.
        whole = iterations >= min(recording.steps for recording in scenario.recorded.values())
        report["early_ends"] = early_ends(list(scenario.recorded.values())) if whole else []
    return report


def fault(robot: str, app: str, reason: str) -> str:
    """Return the reason of an app's fault, with the robot and the app before it unless the author's code has failed:
    such a reason begins with both."""
    return reason if re.match(rf"\w+ on {re.escape(robot)}[,:]", reason) else f"{robot} {app} {reason}"


def is_consensus(scenario: Scenario) -> bool:
    """Return whether the run is about the built-in app, whose truth is known."""
    return scenario.built_in == "consensus"


def result(path: Trajectory) -> Json | None:
    """Return the result columns of the last iteration, by name."""
    if path.last < 0:
        return None
    return {
        name.removeprefix("result."): _number(text)
        for name, text in zip(path.columns, path.rows[path.last], strict=True)
        if name.startswith("result.")
    }


def metrics(paths: Mapping[str, Trajectory]) -> Json:
    """Return an app's own metrics (`error`, `error_NAME`): the mean over the robots at their last iterations, and
    under `NAME_most` the largest."""
    found: Json = {}
    for column in dict.fromkeys(name for path in paths.values() for name in path.columns if is_metric(name)):
        values = [path.value(path.last, column) for path in paths.values() if path.last >= 0]
        known = [value for value in values if math.isfinite(value)]
        name = column.removeprefix("result.")
        found[name] = math.fsum(known) / len(known) if known else None
        found[f"{name}_most"] = max(known, default=None)
    return found


def is_metric(column: str) -> bool:
    """Return whether a column is what an app measures of itself."""
    return column == "result.error" or column.startswith("result.error_")


def bodies(outcome: RunOutcome) -> Json:
    """Return the report of robots that only balance."""
    return {
        name: None
        if body is None
        else {"mode": body.mode, "tilt_deg": round(math.degrees(body.tilt), 2), "fault": body.fault}
        for name, body in outcome.bodies.items()
    }


def true_mean(scenario: Scenario) -> float:
    """Return the mean of the starting values of consensus."""
    values = [float(parameters.get("value", 0.0)) for parameters in scenario.parameters.values()]  # type: ignore[arg-type]
    return math.fsum(values) / len(values)


def consensus_error(scenario: Scenario, paths: Mapping[str, Trajectory]) -> float | None:
    """Largest deviation of a robot's value from the true mean, at its last iteration."""
    mean = true_mean(scenario)
    return max(
        (abs(path.value(path.last, "value") - mean) for path in paths.values() if path.last >= 0),
        default=None,
    )


def estimate(path: Trajectory, k: int | None = None) -> tuple[float, float]:
    """Return the target as a robot sees it at iteration k (the last where None), m; nan where it has no estimate."""
    at = path.last if k is None else k
    if at not in path.rows:
        return (math.nan, math.nan)
    if not {*TARGET_COLUMNS} <= {*path.columns}:
        raise LocalError(
            "a replay compares the results x and y of each robot with what was recorded: this app has none"
        )
    x, y = (path.value(at, name) for name in TARGET_COLUMNS)
    return (x, y)


def target_error_cm(outcome: RunOutcome, estimates: Mapping[str, tuple[float, float]]) -> float | None:
    """Mean distance of the robots' last estimates to the true target, cm; None where a robot has none."""
    targets = outcome.targets()
    distances = [math.dist(place, targets[name]) if name in targets else math.nan for name, place in estimates.items()]
    if not distances or any(math.isnan(distance) for distance in distances):
        return None
    return round(100 * math.fsum(distances) / len(distances), 4)


def replay_deviation_cm(scenario: Scenario, paths: Mapping[str, Trajectory]) -> float | None:
    """Largest distance of an estimate to the recorded one of the same robot and iteration, cm."""
    distances = [
        math.dist(estimate(path, k), recorded)
        for name, path in paths.items()
        for k, recorded in enumerate(scenario.recorded[name].estimates)
        if k in path.rows
    ]
    if not distances or any(math.isnan(distance) for distance in distances):
        return None
    return 100 * max(distances)


def end_deviation_cm(scenario: Scenario, paths: Mapping[str, Trajectory]) -> float | None:
    """Largest distance of a robot's last estimate to the recorded one of the same iteration, cm; None where a robot has
    none, or the recorded ones have not settled by then."""
    distances = []
    for name, path in paths.items():
        recorded = scenario.recorded[name].estimates[: path.last + 1]
        moved = len(set(recorded)) > 1  # else its estimates are not filled in
        if not moved or math.dist(recorded[-1], recorded[2 * len(recorded) // 3]) * 100 > SETTLED_CM:
            return None
        distances.append(math.dist(estimate(path), recorded[-1]))
    return 100 * max(distances) if distances and not any(map(math.isnan, distances)) else None


def _other_end(deviation: float | None) -> list[str]:
    """Return the complaint about a replay with another algorithm that does not end where the recording does."""
    if deviation is None or deviation <= END_BOUND_CM:
        return []
    reason = (
        "likely the measurements are not those of the recorded estimates (a robot's file is missing, or lengths are in "
        "another unit), or this algorithm has not settled yet"
    )
    return [f"the replay ends {deviation:.3g} cm from where the recording ends: {reason}"]


def _mismatch(scenario: Scenario, paths: Mapping[str, Trajectory], deviation: float | None) -> list[str]:
    """Return the complaint about a replay that does not follow the recording."""
    if deviation is None or deviation <= REPLAY_BOUND_CM:
        return []
    first, name = min(
        (k, name)
        for name, path in paths.items()
        for k, recorded in enumerate(scenario.recorded[name].estimates)
        if k in path.rows and 100 * math.dist(estimate(path, k), recorded) > REPLAY_BOUND_CM
    )
    reason = "likely another step size (--step-size) or graph (--topology), or a robot's file or rows are missing"
    where = f"from iteration {first} of {name} on"
    return [f"the replay leaves the recorded trajectory by {deviation:.3g} cm, {where}: {reason}"]


def _number(text: str) -> object:
    """Return a table's cell as the value from which it was written."""
    value = number_or_text(text)
    if isinstance(value, str):
        return {"True": True, "False": False, "": None}.get(value, value)
    return value if math.isfinite(value) else None


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
