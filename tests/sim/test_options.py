import argparse

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.sim import options
from services.sim.options import Cut, Off, Press, Setting
from swarm.errors import ConfigError


def test_durations_and_rates_have_units():
    assert options.duration("30ms") == 0.03
    assert options.duration("2min") == 120
    assert options.duration("1.5") == 1.5
    assert options.rate("78kB") == 78000
    assert options.loss("5%") == options.loss("0.05") == 0.05
    assert options.off("r2@5s,10s") == Off("r2", 5.0, 10.0)
    assert options.off("r2@start,1min") == Off("r2", None, 60.0)
    assert options.cut("r0-r1@12s,3s") == Cut("r0", "r1", 12.0, 3.0)
    assert options.press("r4.a@1500ms") == Press("r4", "A", 1.5)
    assert options.setting("value=0.5") == Setting(None, "value", 0.5)
    assert options.setting("r2.value=3") == Setting("r2", "value", 3)
    assert options.setting("weights=row") == Setting(None, "weights", "row")
    assert options.setting("places=[0.5, 1]") == Setting(None, "places", (0.5, 1.0))


@pytest.mark.parametrize(
    ("convert", "text"),
    [
        (options.duration, "30parsec"),
        (options.duration, "1.2.3s"),
        (options.rate, "0kB"),
        (options.cut, "r0r1@12s,3s"),
        (options.cut, "r0-r1@12s"),
        (options.loss, "95%"),
        (options.loss, "5kB"),
        (options.off, "r2@5s"),
        (options.off, "r2@5s,0s"),
        (options.press, "r4.D@1s"),
        (options.press, "r4@1s"),
        (options.setting, "value"),
        (options.setting, "a b=3"),
        (options.setting, "value=[1,x]"),
    ],
)
def test_wrong_text_is_refused_by_argparse(convert, text):
    with pytest.raises(argparse.ArgumentTypeError):
        convert(text)


@given(st.text(max_size=20))
def test_any_text_is_a_value_or_refused(text):
    for convert in (
        options.duration,
        options.rate,
        options.cut,
        options.loss,
        options.off,
        options.press,
        options.setting,
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
        (["consensus", "--config", "x.toml", "--robots", "3"], "leave out"),
    ],
)
def test_contradictions_are_refused(arguments, words):
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
