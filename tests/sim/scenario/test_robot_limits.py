"""What real robots would refuse is told before a simulation starts."""

from itertools import combinations
from pathlib import Path

import pytest

from sim.scenario import options, scenario
from sim.scenario.notes import too_many_links

NAMES = [f"r{i}" for i in range(9)]
APP = """import numpy
from swarm import SyncApp


class Mine(SyncApp):
    value: float

    def step(self, neighbours):
        pass
"""


def test_more_links_than_a_radio_holds_are_told_with_their_robots() -> None:
    (told,) = too_many_links(NAMES, tuple(combinations(NAMES, 2)), "graph")
    assert "r0, r1, r2, r3, r4, r5, ... with up to 8 links" in told
    assert not list(too_many_links(NAMES[:8], tuple(combinations(NAMES[:8], 2)), "graph"))
    assert not list(too_many_links(NAMES, tuple(combinations(NAMES, 2)), "tree"))


def test_a_package_that_robots_lack_is_told_unless_the_file_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(APP)
    words = ["mine.py", "--robots", "9", "--topology", "full", "--links", "graph"]
    (note,) = scenario.build(options.parse(words), tmp_path).notes  # no robots are named that could lack numpy
    assert note.startswith("real robots would refuse this topology")
    robots = "".join(f'[[robots]]\nname = "{name}"\n' for name in NAMES[:2])
    for packages in ("", '[robot]\npackages = ["numpy"]\n'):
        (tmp_path / "swarm.toml").write_text(f'network = "lab"\n{packages}{robots}[topology]\nedges = [["r0", "r1"]]\n')
        notes = scenario.build(options.parse(["mine.py", "--config", "swarm.toml"]), tmp_path).notes
        told = () if packages else (f"{tmp_path / 'mine.py'}, line 1: import of numpy: robots lack it",)
        assert tuple(note.partition(", if")[0] for note in notes) == told
