"""The thesis' figures 2.10 to 2.14 of one calibration. For the laptop: they need matplotlib."""

from math import hypot
from pathlib import Path
from typing import Any

from services.dwm.calibrate.making import CalibrationData
from services.dwm.core.calibration.fitting import error_of, place_error
from services.dwm.core.calibration.models import RangeModel, position
from services.dwm.core.estimation.filters import inliers, inlying_places
from swarm.config.types import Affine
from swarm.errors import MissingPackageError

_RAW, _FILTERED, _MODEL, _TRUTH, _OUTLIER = "0.7", "black", "#d55e00", "#0072b2", "#cc3311"


def draw(data: CalibrationData, ranges: RangeModel | None, places: Affine | None, path: Path) -> None:
    """Write the picture of what was fitted; raises `MissingPackageError` where matplotlib is missing."""
    try:
        import matplotlib as mpl
    except ImportError:
        raise MissingPackageError("a plot (left out with --no-plot)", "matplotlib", "lab") from None
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    count = 2 * (ranges is not None) + 2 * (places is not None)
    figure, axes = plt.subplots(2, count // 2, figsize=(5.5 * count // 2, 9), layout="constrained", squeeze=False)
    column = 0
    if ranges is not None:
        _ranges(axes[0][0], data, ranges)
        _range_distribution(axes[1][0], data, ranges)
        column = 1
    if places is not None:
        _map(axes[0][column], data, places)
        _place_distribution(axes[1][column], data, places)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _ranges(axes: Any, data: CalibrationData, model: RangeModel) -> None:
    """Figure 2.10: reported minus true distance, so that both panels of the original are one."""
    for group in data.groups:
        kept = set(inliers(group.values))
        for value in group.values:
            colour, mark = (_RAW, ".") if value in kept else (_OUTLIER, "x")
            axes.plot(group.true, 100 * (value - group.true), mark, color=colour, markersize=4)
        axes.plot(group.true, 100 * (group.mean - group.true), "o", color=_FILTERED, markersize=4)
    low, high = min(g.mean for g in data.groups), max(g.mean for g in data.groups)
    measured = [low + (high - low) * i / 200 for i in range(201)]
    true = [model.distance(value) for value in measured]
    bias = [100 * (m - d) for m, d in zip(measured, true, strict=True)]
    axes.plot(true, bias, color=_MODEL, label="model")
    axes.axhline(0.0, color=_TRUTH, linewidth=1, label="uncalibrated")
    axes.set_xlabel("true distance (m)")
    axes.set_ylabel("reported - true (cm)")
    axes.legend()


def _range_distribution(axes: Any, data: CalibrationData, model: RangeModel) -> None:
    """Draw the distribution of range errors (figure 2.11)."""
    raw = [abs(value - g.true) for g in data.groups for value in g.values]
    calibrated = [abs(error_of(model, g, value)) for g in data.groups for value in g.values]
    _cumulative(axes, {"raw": raw, "calibrated": calibrated}, "range error (cm)")


def _map(axes: Any, data: CalibrationData, model: Affine) -> None:
    """Figures 2.12 and 2.13: where the places come out, and what error is left."""
    for spot in data.spots:
        kept = set(inlying_places(spot.values))
        for place in spot.values:
            colour, mark = (_RAW, ".") if place in kept else (_OUTLIER, "x")
            axes.plot(*place, mark, color=colour, markersize=3)
        axes.plot(*position(model, *spot.mean), "o", color="#009e73", markersize=5)
        axes.plot(spot.x, spot.y, "2", color=_FILTERED, markersize=11)
        error = place_error(model, spot, spot.mean)
        gain = error / max(1e-6, hypot(spot.mean[0] - spot.x, spot.mean[1] - spot.y))
        axes.annotate(
            f"{100 * error:.1f} ({gain:.0%})", (spot.x, spot.y), textcoords="offset points", xytext=(5, 5), fontsize=7
        )
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m); numbers: error in cm (part of the uncalibrated)")


def _place_distribution(axes: Any, data: CalibrationData, model: Affine) -> None:
    """Draw the distribution of place errors (figure 2.14)."""
    raw = [hypot(x - s.x, y - s.y) for s in data.spots for x, y in s.values]
    calibrated = [place_error(model, s, value) for s in data.spots for value in s.values]
    _cumulative(axes, {"raw": raw, "calibrated": calibrated}, "place error (cm)")


def _cumulative(axes: Any, errors: dict[str, list[float]], label: str) -> None:
    for (name, values), colour in zip(errors.items(), (_TRUTH, _MODEL), strict=True):
        ordered = sorted(values)
        axes.plot(
            [100 * v for v in ordered], [(i + 1) / len(ordered) for i in range(len(ordered))], color=colour, label=name
        )
    axes.axhline(0.9, color="0.6", linestyle="--", linewidth=1)
    axes.set_xlabel(label)
    axes.set_ylabel("share of samples")
    axes.legend()
