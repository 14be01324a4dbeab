"""`swarm sim --like REPORT`: what was measured of a robot becomes parameters of simulated ones."""

import json
import math
from dataclasses import astuple
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.scenario import commission_report, options, scenario
from sim.scenario.commission_report import MeasuredRobot
from swarm.config import load
from swarm.config.dump import dump
from swarm.errors import ConfigError

STEPS = {
    "bus": {"scl_hz": 62500, "read_kbit_s": 14.0},
    "battery": {"battery_v": 7.81},
    "imu": {"gyro_noise_rad_s": 0.002, "acceleration_noise_m_s2": 0.02, "gyro_zero_rad_s": [0.1, 0.0, 0.0]},
    "uwb": {"anchors": {"C933": {"deviation_m": 0.02}, "D10A": {"deviation_m": 0.06}, "4F21": {"deviation_m": 0.03}}},
    "radio": {"round_trips_ms": {"r1": 44.0, "r2": 52.0}},
    "standing": {"trim_rad": 0.0471},
}
LIKE = MeasuredRobot(62500.0, 0.024, 0.0471, 7.81, 0.002, 0.02, 0.03)


def report(path: Path, steps: dict[str, dict[str, object]], **fields: object) -> Path:
    rows = [{"name": name, "verdict": "passed", "tries": 1, "figures": figures} for name, figures in steps.items()]
    path.write_text(json.dumps({"report": 1, "robot": "r0", "steps": rows} | fields))
    return path


def test_each_figure_becomes_its_parameter_of_all_robots(tmp_path: Path) -> None:
    path = report(tmp_path / "report.json", STEPS)
    assert commission_report.read(path) == LIKE
    read = options.parse(["consensus", "--robots", "2", "--like", str(path)])
    assert read.latency == 0.024
    config = scenario.build(read, tmp_path).config
    # A run's processes read the file that is written for them.
    written = tmp_path / "swarm.toml"
    written.write_text(dump(config))
    simulation = load(written).simulation
    assert (simulation.scl, simulation.battery, simulation.range_noise) == (62500.0, 7.81, 0.03)
    assert (simulation.gyro_noise, simulation.acceleration_noise) == (0.002, 0.02)
    assert load(written).body_of("r1").trim == 0.0471


def test_a_latency_that_is_given_goes_before_the_report(tmp_path: Path) -> None:
    path = report(tmp_path / "report.json", STEPS)
    assert options.parse(["--like", str(path), "--latency", "5ms"]).latency == 0.005
    assert options.parse([]).latency == options.LATENCY


def test_what_a_report_lacks_stays_as_it_is(tmp_path: Path) -> None:
    steps = {"imu": {"gyro_noise_rad_s": 0.0}, "uwb": {"anchors": {}}, "radio": {"round_trips_ms": {}}}
    path = report(tmp_path / "report.json", steps)
    assert commission_report.read(path) == MeasuredRobot()


@pytest.mark.parametrize(
    ("steps", "named"),
    [
        ({"bus": {"scl_hz": "fast"}}, "bus: scl_hz"),
        ({"bus": {"scl_hz": 3.0}}, "bus: scl_hz"),
        ({"radio": {"round_trips_ms": {"r1": -1.0}}}, "radio: round_trips_ms"),
        ({"uwb": {"anchors": {"C933": {}}}}, "uwb: anchors"),
        ({"uwb": {"anchors": 3}}, "uwb: anchors"),
    ],
)
def test_a_figure_that_cannot_be_is_refused_by_name(tmp_path: Path, steps: dict[str, object], named: str) -> None:
    path = report(tmp_path / "report.json", steps)
    with pytest.raises(ConfigError, match=named):
        commission_report.read(path)


def test_a_file_that_is_no_report_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    for text in ("{}", "[", '{"report": 2, "steps": []}'):
        path.write_text(text)
        with pytest.raises(ConfigError, match="report"):
            commission_report.read(path)
    with pytest.raises(ConfigError, match="No such file"):
        commission_report.read(tmp_path / "none.json")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.dictionaries(
        st.sampled_from(sorted(STEPS)),
        st.dictionaries(
            st.sampled_from(["scl_hz", "trim_rad", "anchors", "round_trips_ms", "battery_v"]), JSON, max_size=3
        ),
    )
)
def test_any_report_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, steps: dict[str, object]) -> None:
    path = report(tmp_path_factory.mktemp("like") / "report.json", steps)
    try:
        found = commission_report.read(path)
    except ConfigError:
        return
    assert all(value is None or math.isfinite(value) for value in astuple(found))
