"""`swarm sim --like REPORT`: what `swarm commission` has measured of a robot, as parameters of the simulated ones.

| figure of the report | parameter |
|---|---|
| `bus`: scl_hz | clock of the simulated I2C bus |
| `radio`: round_trips_ms | latency of links: half of the median |
| `standing`: trim_rad | `trim` in [body] |
| `battery`: battery_v | voltage of the simulated battery |
| `imu`: gyro_noise_rad_s, acceleration_noise_m_s2 | noise of the simulated IMU |
| `uwb`: anchors' deviation_m | noise of simulated ranges: the median |

A figure that the report lacks, or a noise of 0 (a figure too small for its decimals), leaves its parameter as it is.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from swarm.config import Config
from swarm.errors import ConfigError, PayloadError
from swarm.frozen import frozen
from swarm.messages.json_input import read_json

LONGEST = 1 << 20
"""Largest report that is read, bytes."""


@frozen
class MeasuredRobot:
    """The measurements of one robot in a report; None where it has none."""

    scl: float | None = None
    """Hz."""
    latency: float | None = None
    """s."""
    trim: float | None = None
    """rad."""
    battery: float | None = None
    """V."""
    gyro_noise: float | None = None
    """rad/s."""
    acceleration_noise: float | None = None
    """m/s^2."""
    range_noise: float | None = None
    """m."""


def read(path: Path) -> MeasuredRobot:
    """Read a report of `swarm commission`; raises `ConfigError` with file and figure where it is none."""
    try:
        with path.open("rb") as file:
            data = read_json(file.read(LONGEST))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except PayloadError as error:
        raise ConfigError(f"{path}: {error}") from None
    if not isinstance(data, dict) or data.get("report") != 1 or not isinstance(data.get("steps"), list):
        raise ConfigError(f"{path}: no report of swarm commission")
    steps = {
        str(row.get("name")): row["figures"]
        for row in data["steps"]
        if isinstance(row, dict) and isinstance(row.get("figures"), dict)
    }
    figures = _Figures(path, steps)
    trip = figures.middle("radio", "round_trips_ms", "", 0.0, 1e5)
    return MeasuredRobot(
        scl=figures.one("bus", "scl_hz", 1.1e4, 1e6),
        latency=None if trip is None else trip / 2e3,
        trim=figures.one("standing", "trim_rad", -0.5, 0.5),
        battery=figures.one("battery", "battery_v", 0.1, 12.0),
        gyro_noise=figures.one("imu", "gyro_noise_rad_s", 0.0, 1.0) or None,
        acceleration_noise=figures.one("imu", "acceleration_noise_m_s2", 0.0, 10.0) or None,
        range_noise=figures.middle("uwb", "anchors", "deviation_m", 0.0, 10.0) or None,
    )


def apply(config: Config, like: MeasuredRobot) -> Config:
    """Return the configuration with what was measured, for all of its robots; latency is none of its parameters."""
    measured = {
        name: value
        for name in ("scl", "battery", "gyro_noise", "acceleration_noise", "range_noise")
        if (value := getattr(like, name)) is not None
    }
    body = config.body if like.trim is None else replace(config.body, trim=like.trim)
    return replace(config, body=body, simulation=replace(config.simulation, **measured))


class _Figures:
    """Figures of a report by step and name."""

    def __init__(self, path: Path, steps: Mapping[str, Mapping[str, Any]]) -> None:
        self._path, self._steps = path, steps

    def one(self, step: str, name: str, low: float, high: float) -> float | None:
        """Return a figure, or None where there is none; `ConfigError` where it is no number from `low` to `high`."""
        value = self._steps.get(step, {}).get(name)
        return None if value is None else self._number(f"{step}: {name}", value, low, high)

    def middle(self, step: str, name: str, inner: str, low: float, high: float) -> float | None:
        """Return the median of the figures by anchor or neighbour (`inner`: a figure of each), or None."""
        table = self._steps.get(step, {}).get(name)
        if not table:
            return None
        if not isinstance(table, dict):
            raise ConfigError(f"{self._path}: {step}: {name}: expected a table")
        values = [row.get(inner) if inner and isinstance(row, dict) else row for row in table.values()]
        return median(self._number(f"{step}: {name}", value, low, high) for value in values)

    def _number(self, what: str, value: object, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ConfigError(f"{self._path}: {what}: expected {low:g} to {high:g}, got {str(value)[:40]}")
        return float(value)
