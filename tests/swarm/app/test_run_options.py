"""How a run ends and what it does about robots that stay away, as options and back."""

import argparse

import pytest

from swarm.app import run_options
from swarm.errors import ConfigError


@pytest.mark.parametrize("last", [[], ["--iterations", "7"]])
@pytest.mark.parametrize(
    "end", [[], ["--until", "converged", "--rounds", "5", "--tolerance", "1e-06"], ["--for", "1.5"]]
)
@pytest.mark.parametrize("away", [[], ["--absent", "drop", "--drop-after", "2.0"]])
def test_its_words_say_the_same(last: list[str], end: list[str], away: list[str]) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--iterations", type=int)
    run_options.add_arguments(parser)
    found = run_options.of(parser.parse_args([*last, *end, *away]))
    assert found.arguments == [*last, *end, *away]
    assert found.last == (7 if last else None)


@pytest.mark.parametrize(
    ("words", "mend"),
    [
        (["--rounds", "5"], "--until converged"),
        (["--tolerance", "1e-3"], "--until converged"),
        (["--for", "5", "--rounds", "5"], "--until converged"),
        (["--drop-after", "2"], "--absent drop"),
    ],
)
def test_an_option_that_would_change_nothing_is_refused(words: list[str], mend: str) -> None:
    parser = argparse.ArgumentParser()
    run_options.add_arguments(parser)
    with pytest.raises(ConfigError, match=mend):
        run_options.of(parser.parse_args(words))
