"""The making of a calibration: from samples to a file, to tables for people, and to a verdict on one that is in use."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from services.dwm.core.calibration import calibration_file, fitting, limits, samples
from services.dwm.core.calibration.calibration_file import CalibrationFile, Evidence
from services.dwm.core.calibration.models import Calibration, RangeModel
from services.dwm.core.calibration.samples import Point3, RangeSample, SampleGroup, Spot
from services.dwm.core.estimation import thesis
from services.dwm.core.estimation.filters import Place, mean
from swarm.config import Config
from swarm.config.types import Anchor
from swarm.errors import ConfigError, LocalError, PayloadError, RecordingError
from swarm.files import atomic_write, make_folder
from swarm.frozen import frozen
from swarm.messages.json_input import read_json

SLACK = 0.01
"""Allowance of a check, m. Its error may be one and a half times that of the fit at places left out, plus this: a check
has fewer samples."""


_LONGEST_REPORT = 1 << 20
"""The most bytes of a report that is read."""


@frozen
class LearnedOffset:
    """The amount by which a robot's ranges are too long, and the samples from which it was learned."""

    offset: float
    """The robot's own range offset, m."""
    places: int
    samples: int
    left: float
    """Root mean square of the remaining errors, m."""
    sha256: str
    """SHA-256 of the samples, or of the report."""


@frozen
class CalibrationData:
    """Samples, and what can be compared with the truth."""

    samples: tuple[RangeSample, ...]
    groups: tuple[SampleGroup, ...]
    spots: tuple[Spot, ...]

    @classmethod
    def of(cls, found: Sequence[RangeSample], modules: Mapping[str, Point3]) -> "CalibrationData":
        """`modules`: places of those whose ranges count."""
        return cls(tuple(found), tuple(samples.groups(found, modules)), tuple(samples.spots(found)))


def read(path: Path, places: Sequence[Place] | None, target: str | None) -> list[RangeSample]:
    """Return the samples of a file, or of all `*.csv` of a folder. Places of different files are different places.

    `places` (m) and `target` (its address) go with files in the thesis' layout.
    """
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path]
    if not files:
        raise RecordingError(f"{path}: holds no *.csv")
    read_one = partial(samples.read, places=places, module=target or samples.TARGET)
    found: list[RangeSample] = []
    for file in files:
        try:
            text = file.read_text("utf-8", "replace")
        except OSError as error:
            raise RecordingError(f"{file}: cannot be read: {error.strerror}") from None
        first = 1 + max((sample.place for sample in found), default=-1)
        found += [sample._replace(place=sample.place + first) for sample in read_one(text, str(file))]
    return found


def distance_part(data: CalibrationData, made: str) -> tuple[CalibrationFile, fitting.FittedRanges]:
    """Fit the model of ranges alone; the file has no robot and layout yet."""
    if not data.groups:
        raise LocalError(
            "no range to a module of known place among the samples: give the target's place with --target X Y, or list "
            "the module among [[anchors]]"
        )
    fit = fitting.fit_ranges(data.groups)
    evidence = _evidence(fit, made, data, len({g.place for g in data.groups}))
    return CalibrationFile("", "", (), distance=(fit.model, evidence)), fit


def position_part(data: CalibrationData, made: str) -> tuple[CalibrationFile, fitting.PlaceFitted]:
    """Fit the model of places alone; the file has no robot and layout yet."""
    fit = fitting.fit_places(data.spots)
    evidence = _evidence(fit, made, data, len(data.spots))
    return CalibrationFile("", "", (), position=(fit.model, evidence)), fit


def save(part: CalibrationFile, path: Path, robot: str, anchors: Sequence[Anchor]) -> CalibrationFile:
    """Write `part` for `robot` to `path`; the other part of a file that is there stays where it belongs to the same
    robot and anchors."""
    layout = calibration_file.layout_of(anchors)
    file = CalibrationFile(
        robot, layout, calibration_file.described(anchors), distance=part.distance, position=part.position
    )
    if path.exists():
        before = calibration_file.parse(path.read_text("utf-8"), str(path))
        if (before.robot, before.layout) == (robot, layout):
            file = before.with_parts(file)
    text = calibration_file.text_of(file)
    try:
        calibration_file.parse(text, str(path))
    except ConfigError as error:
        raise LocalError(f"this fit would be refused when it is read ({error}): nothing is written") from None
    make_folder(path.parent)
    atomic_write(path, text.encode())
    return file


def with_offset(
    file: CalibrationFile | None, learned: LearnedOffset, made: str, robot: str, config: Config
) -> CalibrationFile:
    """Return the file with its robot's ranges shorter by an offset more; where it has no model of ranges, with the one
    of swarm.toml. Raises `ConfigError` where the file is another robot's, or the anchors stand elsewhere now."""
    anchors = config.anchors
    if file is None:
        layout = calibration_file.layout_of(anchors)
        file = CalibrationFile(robot, layout, calibration_file.described(anchors))
    calibration_file.check(file, "the calibration", robot, anchors)
    if file.distance is None:
        evidence = Evidence(
            "[dwm.distance]", made, learned.places, learned.samples, learned.sha256, {}, learned.left, ()
        )
        model = RangeModel.of(config.dwm.distance)
    else:
        model, evidence = file.distance
    if learned.sha256 in evidence.offsets:
        raise ConfigError(
            "the calibration has this offset already: it was made of the same samples. Measure anew under the "
            "calibration in use, or fit a new model (swarm calibrate distance)"
        )
    limits.check_offset(model.robot + learned.offset)
    evidence = replace(evidence, offsets=(*evidence.offsets, learned.sha256))
    return replace(file, distance=(replace(model, robot=model.robot + learned.offset), evidence))


def offset_of(path: Path, robot: str) -> LearnedOffset:
    """Read the offset from a report of `swarm commission`; raises `RecordingError` where it holds none of `robot`."""
    try:
        with path.open("rb") as file:
            data = file.read(_LONGEST_REPORT)
        report = read_json(data)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    except PayloadError as error:
        raise RecordingError(f"{path}: {error}") from None
    steps = report.get("steps") if isinstance(report, dict) else None
    if not isinstance(report, dict) or not isinstance(steps, list):
        raise RecordingError(f"{path}: no report of swarm commission")
    if report.get("robot") != robot:
        raise RecordingError(f"{path}: is of {str(report.get('robot'))[:40]}, not of {robot}")
    step = next((each for each in steps if isinstance(each, dict) and each.get("name") == "offset"), {})
    figures = step.get("figures") if step.get("verdict") == "passed" else None
    found = figures if isinstance(figures, dict) else {}
    offset, errors, places = (found.get(name) for name in ("range_offset_m", "anchor_errors_m", "places"))
    values = list(errors.values()) if isinstance(errors, dict) else []
    if not (isinstance(places, int) and values and all(map(_is_number, [offset, *values]))):
        raise RecordingError(f"{path}: no offset was learned; swarm commission {robot} does it in its step `offset`")
    assert isinstance(offset, float | int)
    left = fitting.rms([value - offset for value in values])
    return LearnedOffset(float(offset), places, len(values) * places, left, hashlib.sha256(data).hexdigest())


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e6


def fit_text(what: str, name: str, left_out: Mapping[str, float], nested: float, places: int, count: int) -> str:
    """Return the table of the models that competed."""
    lines = [f"{what}: {count} samples at {places} places; rms error at places left out of the fit:"]
    lines += [
        f"  {model:<18}{100 * error:6.2f} cm{'  <- taken' if model == name else ''}"
        for model, error in left_out.items()
    ]
    lines.append(f"  the choice made anew without each place: {100 * nested:.2f} cm")
    return "\n".join(lines)


def thesis_text(found: Sequence[RangeSample]) -> str:
    """Return the thesis' figures from these samples, which must be its own."""
    d, p = thesis.distances(found), thesis.positions(found)
    ((a, b), (c, e)), (u, v) = p.model.matrix, p.model.offset
    return "\n".join(
        [
            f"eq. 2.4   m = {d.gain:.3f} d + {d.offset:.3f} cm   ({d.samples} samples, {d.outliers} outliers)",
            f"eq. 2.8   d = {1 / d.gain:.6f} m - {d.offset / d.gain:.6f} cm",
            f"eq. 2.10  [[{a:.3f}, {b:.3f}], [{c:.3f}, {e:.3f}]] m + [{u:.3f}, {v:.3f}]",
            f"table 2.3 mean, rms: {abs(d.uncalibrated[0]):.2f}, {d.uncalibrated[1]:.2f} cm -> "
            f"{d.calibrated[0]:.3f}, {d.calibrated[1]:.2f} cm",
            f"table 2.4 mean, rms: {p.uncalibrated[0]:.2f}, {p.uncalibrated[1]:.2f} cm -> "
            f"{abs(p.calibrated[0]):.2f}, {p.calibrated[1]:.2f} cm (each coordinate; "
            f"distance {p.uncalibrated_2d:.2f} -> {p.calibrated_2d:.2f})",
            f"fig. 2.11 90 %: {d.raw_90:.1f} cm raw (the thesis says 19), {d.processed_90:.2f} processed (4; "
            f"{d.processed_80:.2f} is the 80 % point)",
            f"fig. 2.14 90 %: {p.raw_90:.1f} cm raw (15), {p.processed_90:.2f} processed (8)",
        ]
    )


def verdict(models: Calibration, file: CalibrationFile | None, data: CalibrationData) -> tuple[list[str], bool]:
    """Judge the models in use by fresh samples: lines for people, and whether the models may stay."""
    lines: list[str] = []
    good = True
    if data.groups:
        errors = [fitting.error_of(models.ranges, g, g.mean) for g in data.groups]
        nested = file.distance[1].nested if file and file.distance else None
        good &= _judge(lines, "ranges", errors, nested)
        offset = mean(errors)
        if abs(offset) > 0.5 * fitting.rms(errors) and not good:
            lines.append(
                f"  all are {100 * abs(offset):.1f} cm too {'long' if offset > 0 else 'short'} on the mean: another "
                "module, or an anchor that was moved?"
            )
    if data.spots:
        errors = [fitting.place_error(models.position, s, s.mean) for s in data.spots]
        nested = file.position[1].nested if file and file.position else None
        good &= _judge(lines, "places", errors, nested)
    if not lines:
        raise LocalError("no samples to check: does the module give ranges? See swarm dwm check")
    return lines, good


def _judge(lines: list[str], what: str, errors: Sequence[float], nested: float | None) -> bool:
    error = fitting.rms(errors)
    if nested is None:
        lines.append(f"{what}: rms error {100 * error:.1f} cm; no calibration file to compare with")
        return True
    limit = 1.5 * nested + SLACK
    words = "as when it was made" if error <= limit else f"more than {100 * limit:.1f}: calibrate anew"
    lines.append(f"{what}: rms error {100 * error:.1f} cm, {100 * nested:.1f} when it was made: {words}")
    return error <= limit


def _evidence(
    fit: fitting.FittedRanges | fitting.PlaceFitted, made: str, data: CalibrationData, places: int
) -> Evidence:
    residuals = tuple(tuple(round(value, 5) for value in row) for row in fit.residuals)
    count, digest = len(data.samples), samples.digest(data.samples)
    return Evidence(fit.name, made, places, count, digest, fit.left_out, fit.nested, residuals)
