"""A robot's own UWB offset goes from its commissioning report into its calibration."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.calibrate import __main__ as calibrate
from services.dwm.calibrate import making
from services.dwm.core.calibration import calibration_file
from services.dwm.core.calibration.calibration_file import CalibrationFile, Evidence
from services.dwm.core.calibration.models import RangeModel
from swarm import config as configuration
from swarm.errors import ConfigError, LocalError, RecordingError

SWARM = """network = "lab"
[[robots]]
name = "r0"
link = "tcp:127.0.0.1:9000"
[[anchors]]
address = "D001"
x = 0.0
y = 0.0
[dwm]
calibration = "of/{robot}.toml"
[dwm.distance]
gain = 0.95
offset = -0.06
"""
FIGURES = {"range_offset_m": 0.04, "anchor_errors_m": {"C933": 0.03, "D10A": 0.05}, "places": 3}


def report(folder: Path, figures: object, robot: str = "r0", verdict: str = "passed") -> Path:
    path = folder / "report.json"
    step = {"name": "offset", "verdict": verdict, "tries": 1, "figures": figures}
    path.write_text(json.dumps({"report": 1, "robot": robot, "steps": [step]}))
    return path


def test_a_learned_offset_is_added_to_the_model_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "swarm.toml").write_text(SWARM)
    monkeypatch.setenv("SWARM_CONFIG", str(tmp_path / "swarm.toml"))
    path = tmp_path / "of" / "r0.toml"
    for places, total in (3, 0.04), (4, 0.08):  # the second report: how much too long ranges are under the first one
        words = ["offset", str(report(tmp_path, {**FIGURES, "places": places})), "--robots", "r0", "--write"]
        assert calibrate.main(words) == 0
        file = calibration_file.parse(path.read_text(), "f")
        assert file.distance is not None
        model, evidence = file.distance
        assert (model.gain, model.offset, model.robot) == (0.95, -0.06, pytest.approx(total))
        assert (evidence.places, evidence.nested) == (3, pytest.approx(0.01))


def test_a_report_is_taken_over_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "swarm.toml").write_text(SWARM)
    monkeypatch.setenv("SWARM_CONFIG", str(tmp_path / "swarm.toml"))
    words = ["offset", str(report(tmp_path, FIGURES)), "--robots", "r0", "--write"]
    assert calibrate.main(words) == 0
    with pytest.raises(ConfigError, match="the calibration has this offset already"):
        calibrate.main(words)


def test_a_report_is_added_once_to_a_model_that_was_fitted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its evidence is the fit's. So the file itself tells which offsets it has, whatever came after them."""
    (tmp_path / "swarm.toml").write_text(SWARM)
    monkeypatch.setenv("SWARM_CONFIG", str(tmp_path / "swarm.toml"))
    anchors = configuration.load(tmp_path / "swarm.toml").anchors
    fitted = Evidence("linear", "2026-11-21T06:00:00+00:00", 5, 50, "00", {}, 0.02, ())
    part = CalibrationFile("", "", (), distance=(RangeModel(0.9, -0.01), fitted))
    making.save(part, tmp_path / "of" / "r0.toml", "r0", anchors)
    for number in 1, 2:
        (tmp_path / f"{number}").mkdir()
        figures = {**FIGURES, "places": 2 + number, "range_offset_m": 0.01 * number}
        words = ["offset", str(report(tmp_path / f"{number}", figures)), "--robots", "r0", "--write"]
        assert calibrate.main(words) == 0
        with pytest.raises(ConfigError, match="the calibration has this offset already"):
            calibrate.main(words)
    assert "the robot's own offset was +1.00 cm and is +3.00 cm" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="the calibration has this offset already"):
        calibrate.main(["offset", str(tmp_path / "1/report.json"), "--robots", "r0", "--write"])
    model, evidence = calibration_file.parse((tmp_path / "of/r0.toml").read_text(), "f").distance or (None, None)
    assert model == RangeModel(0.9, -0.01, robot=pytest.approx(0.03))
    assert (evidence and replace(evidence, offsets=())) == fitted
    making.save(part, tmp_path / "of" / "r0.toml", "r0", anchors)
    assert calibrate.main(words) == 0, "a new fit has no offset yet"


def test_a_report_without_an_offset_or_of_another_robot_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is of r1, not of r0"):
        making.offset_of(report(tmp_path, FIGURES, robot="r1"), "r0")
    for path in (report(tmp_path, {}), report(tmp_path, FIGURES, verdict="failed")):
        with pytest.raises(RecordingError, match="no offset was learned; swarm commission r0"):
            making.offset_of(path, "r0")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from([*FIGURES, "C933"]), inner, max_size=3),
    max_leaves=6,
)


@given(JSON | st.fixed_dictionaries(dict.fromkeys(FIGURES, JSON)))
def test_any_report_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, figures: object) -> None:
    path = report(tmp_path_factory.mktemp("report"), figures)
    try:
        learned = making.offset_of(path, "r0")
    except LocalError:
        return
    assert abs(learned.offset) < 1e6
