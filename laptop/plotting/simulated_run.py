"""One picture of a run: states over iterations, and for localization the map with everybody's estimates."""

import math
from pathlib import Path

from laptop.plotting import simulated_scene, style
from laptop.plotting.palette import COLOURS
from sim import report, scene
from sim.report import Json, RunOutcome


def draw(outcome: RunOutcome, summary: Json, path: Path) -> None:
    """Write the picture of `outcome` to `path`; the ending says in which format."""
    if outcome.scene_record is not None and outcome.scenario.app in scene.WATCHED:
        simulated_scene.draw(outcome.scenario, outcome.scene_record, outcome.began, path)
        return
    # Slow to import and only wanted here. Agg: no display is needed.
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    localization = outcome.scenario.app == "localization"
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    if localization:
        _map(axes[0], outcome)
        _errors(axes[1], outcome)
    else:
        _states(axes[0], outcome, against_time=False)
        _states(axes[1], outcome, against_time=True)
    figure.suptitle(_title(summary))
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _title(summary: Json) -> str:
    words = [str(summary["app"]), f"({summary['algorithm']})" if summary["algorithm"] else ""]
    words.append(f"{summary['robots']} robots, {summary['topology']}")
    median = summary["iteration_s_median"]
    if isinstance(median, float):
        words.append(f"{1e3 * median:.1f} ms an iteration")
    error = summary.get("error_cm")
    if isinstance(error, float):
        words.append(f"error {error:.1f} cm")
    return "  ".join(word for word in words if word)


def _map(axes, outcome: RunOutcome) -> None:  # type: ignore[no-untyped-def]
    config = outcome.scenario.config
    for anchor in config.anchors:
        axes.plot(anchor.x, anchor.y, "^", color="0.4", markersize=9)
        axes.annotate(anchor.address, (anchor.x, anchor.y), textcoords="offset points", xytext=(6, 6), color="0.4")
    for a, b in config.edges:
        (xa, ya, _), (xb, yb, _) = config.simulation.places[a], config.simulation.places[b]
        axes.plot((xa, xb), (ya, yb), color="0.85", zorder=0)
    for index, name in enumerate(config.names):
        colour = COLOURS[index % len(COLOURS)]
        x, y, _ = config.simulation.places[name]
        axes.plot(x, y, "o", color=colour, markersize=9)
        axes.annotate(name, (x, y), textcoords="offset points", xytext=(7, 7), color=colour)
        path = outcome.trajectories[name]
        track = [report.estimate(path, k) for k in sorted(path.rows)]
        track = [place for place in track if not math.isnan(place[0])]
        if track:
            axes.plot(*zip(*track, strict=True), "-", color=colour, linewidth=0.8, alpha=0.7)
            axes.plot(*track[-1], "x", color=colour, markersize=9)
    way = [config.simulation.target, *outcome.targets().values()]
    axes.plot(*zip(*way, strict=True), "-", color="crimson", linewidth=1, zorder=0)
    axes.plot(*way[-1], "*", color="crimson", markersize=16, zorder=0, label="target")
    axes.plot([], [], "x", color="0.2", label="estimates")
    axes.plot([], [], "^", color="0.4", linestyle="none", label="anchors")
    axes.set(xlabel="x / m", ylabel="y / m", aspect="equal", title="robots, mesh and estimates of the target")
    # A first estimate may be far out; the picture is about the table.
    places = [place[:2] for place in config.simulation.places.values()] + [(a.x, a.y) for a in config.anchors]
    xs, ys = zip(*places, *way, strict=True)
    axes.set(xlim=(min(xs) - 0.3, max(xs) + 0.45), ylim=(min(ys) - 0.3, max(ys) + 0.3))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False, fontsize="small")
    axes.grid(alpha=0.3)


def _errors(axes, outcome: RunOutcome) -> None:  # type: ignore[no-untyped-def]
    for index, (name, path) in enumerate(outcome.trajectories.items()):
        ks = sorted(path.rows)
        errors = [100 * math.dist(report.estimate(path, k), outcome.target(path.times[k])) for k in ks]
        axes.plot(ks, errors, color=COLOURS[index % len(COLOURS)], linewidth=1, label=name)
    for index, (name, recording) in enumerate(outcome.scenario.recorded.items()):
        target = outcome.scenario.config.simulation.target  # it stands: recordings are of such
        errors = [100 * math.dist(place, target) for place in recording.estimates]
        label = "recorded" if index == 0 else None
        axes.plot(errors, color=COLOURS[index % len(COLOURS)], linewidth=1, linestyle=":", label=label)
        del name
    axes.set(
        xlabel="iteration",
        ylabel="distance to the true target / cm",
        yscale="log",
    )
    style.legend(axes, len(outcome.trajectories) + bool(outcome.scenario.recorded), fontsize="small", frameon=False)
    axes.grid(alpha=0.3, which="both")


def _states(axes, outcome: RunOutcome, *, against_time: bool) -> None:  # type: ignore[no-untyped-def]
    starts = [min(path.times.values()) for path in outcome.trajectories.values() if path.times]
    origin = min(starts, default=0.0)
    shown: dict[str, None] = {}
    for index, (name, path) in enumerate(outcome.trajectories.items()):
        columns = [column for column in path.columns if not column.startswith("result.")]
        for column in columns[:1]:
            ks = sorted(path.rows)
            at = [path.times[k] - origin for k in ks] if against_time else ks
            shown[column] = None
            axes.plot(at, [path.value(k, column) for k in ks], ".-", color=COLOURS[index % len(COLOURS)], markersize=3,
                      linewidth=1, label=name)  # fmt: skip
    axes.set(xlabel="time / s" if against_time else "iteration", ylabel=next(iter(shown), "state"))
    if not against_time:
        style.legend(axes, len(outcome.trajectories), fontsize="small", frameon=False)
    axes.grid(alpha=0.3)
