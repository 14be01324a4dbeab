import argparse
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim import disturbances
from sim.disturbances import Cut, Kill, Off, ScheduledPress, ScheduledPush, Span
from sim.scenario import options, quantities
from swarm.app.settings import Setting
from swarm.errors import ConfigError


def test_durations_and_rates_have_units():
    assert quantities.duration("30ms") == 0.03
    assert quantities.duration("2min") == 120
    assert quantities.duration("1.5") == 1.5
    assert quantities.rate("78kB") == 78000
    assert quantities.loss("5%") == quantities.loss("0.05") == 0.05
    assert disturbances.parsed_off("r2@5s,10s") == Off("r2", 5.0, 10.0)
    assert disturbances.parsed_off("r2@start,1min") == Off("r2", None, 60.0)
    assert disturbances.parsed_cut("r0-r1@12s,3s") == Cut("r0", "r1", 12.0, 3.0)
    assert disturbances.parsed_press("r4.a@1500ms") == ScheduledPress("r4", "A", 1.5)
    assert disturbances.parsed_cut("r0-r1@2s..5s,3s") == Cut("r0", "r1", 2.0, 3.0, Span(2.0, 5.0))
    assert disturbances.parsed_kill("r4.app@1s") == Kill("r4", "app", 1.0)
    assert disturbances.parsed_push("r4@1s") == ScheduledPush("r4", 1.0, 0.1)
    assert disturbances.parsed_push("any@1s..2s,-0.5") == ScheduledPush("any", 1.0, -0.5, Span(1.0, 2.0))
    assert quantities.velocity("0.1, -0.03") == (0.1, -0.03)
    assert quantities.setting("value=0.5") == ("", Setting(None, "value", 0.5))
    assert quantities.setting("r2.value=3") == ("", Setting("r2", "value", 3))
    assert quantities.setting("weights=row") == ("", Setting(None, "weights", "row"))
    assert quantities.setting("places=[0.5, 1]") == ("", Setting(None, "places", (0.5, 1.0)))
    assert quantities.setting("led_sync/r1.tolerance=0.1") == ("led_sync", Setting("r1", "tolerance", 0.1))
    assert quantities.setting("file=a/b") == ("", Setting(None, "file", "a/b"))


@pytest.mark.parametrize(
    ("convert", "text"),
    [
        (quantities.duration, "30parsec"),
        (quantities.duration, "1.2.3s"),
        (quantities.rate, "0kB"),
        (disturbances.parsed_cut, "r0r1@12s,3s"),
        (disturbances.parsed_cut, "r0-r1@12s"),
        (disturbances.parsed_cut, "r0-r1@12s,0s"),
        (quantities.loss, "95%"),
        (quantities.loss, "5kB"),
        (disturbances.parsed_off, "r2@5s"),
        (disturbances.parsed_off, "r2@5s,0s"),
        (disturbances.parsed_press, "r4.D@1s"),
        (disturbances.parsed_press, "r4@1s"),
        (disturbances.parsed_off, "r2@5s..2s,1s"),
        (disturbances.parsed_kill, "r2@5s"),
        (disturbances.parsed_kill, "r2.sshd@5s"),
        (disturbances.parsed_push, "r2@5s,0"),
        (disturbances.parsed_push, "r2@5s,9"),
        (disturbances.parsed_push, "r2@5s,hard"),
        (quantities.setting, "value"),
        (quantities.setting, "a b=3"),
        (quantities.setting, "value=[1,x]"),
        (quantities.velocity, "0.1"),
        (quantities.velocity, "0.1,x"),
        (quantities.velocity, "nan,0"),
        (quantities.velocity, "0,99"),
    ],
)
def test_wrong_text_is_refused_by_argparse(convert, text):
    with pytest.raises(argparse.ArgumentTypeError):
        convert(text)


@given(st.text(max_size=20))
def test_any_text_is_a_value_or_refused(text):
    for convert in (
        quantities.duration,
        quantities.rate,
        disturbances.parsed_cut,
        quantities.loss,
        disturbances.parsed_off,
        disturbances.parsed_press,
        disturbances.parsed_kill,
        disturbances.parsed_push,
        quantities.setting,
    ):
        try:
            convert(text)
        except argparse.ArgumentTypeError:
            continue


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--algorithm", "thesis"], "needs an APP"),
        (["--iterations", "5"], "needs an APP"),
        (["--virtual", "--robots", "2"], "--virtual needs an APP, or --seconds"),
        (["--virtual", "--seconds", "3", "--record", "x"], "--record under --virtual needs an APP"),
        (["consensus", "--config", "x.toml", "--robots", "3"], "leave out"),
        (["consensus", "--mesh", "delay"], "choose models of --virtual"),
        (["consensus", "--robots", "101"], "more than 100 are for --virtual"),
        (["consensus", "--body", "point"], "choose models of --virtual"),
    ],
)
def test_options_that_contradict_each_other_are_refused(arguments, words):
    with pytest.raises(ConfigError, match=words):
        options.parse(arguments)


@pytest.mark.parametrize(
    "arguments",
    [["--robots", "0"], ["consensus", "--seconds", "3", "--iterations", "4"], ["consensus", "--step-size", "-1"]],
)
def test_wrong_numbers_end_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        options.parse(arguments)
    assert ended.value.code == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize("words", [("--target-velocity", "-0.05,0.02"), ("--target-velocity=-0.05,0.02",)])
def test_a_value_may_begin_with_a_minus(words):
    assert options.parse(["localization", *words, "--virtual"]).target_velocity == (-0.05, 0.02)


def test_a_negative_time_is_refused_for_what_it_is():
    with pytest.raises(ConfigError, match="--latency: '-5ms' is not a time"):
        options.parse(["consensus", "--latency", "-5ms"], ends=False)


@pytest.mark.parametrize(
    ("name", "problem"), [("x.xyz", r"ends in \.png, \.pdf"), ("no/x.png", "there is no folder no")]
)
def test_a_picture_that_cannot_be_drawn_is_refused_before_the_run(name, problem):
    with pytest.raises(ConfigError, match=problem):
        options.parse(["consensus", "--plot", name], ends=False)


def test_a_picture_without_an_ending_is_a_png():
    assert options.parse(["consensus", "--plot", "run"]).plot == Path("run.png")


def test_a_picture_may_be_drawn_into_the_folder_of_the_recording(tmp_path):
    words = ["consensus", "--record", str(tmp_path / "new"), "--plot", str(tmp_path / "new" / "x.svg")]
    assert options.parse(words).plot == tmp_path / "new" / "x.svg"
