"""How a run ends and what it does about robots that stay away, as options and back."""

import argparse

import pytest

from swarm.app import run_options


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
