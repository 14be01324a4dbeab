"""The commands of the page about fitting the slot radio: the rehearsal finds what the simulation was given."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/how-to/network/fit-the-radio.md"

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def test_the_rehearsal_finds_the_parameters_that_it_was_given(tmp_path: Path) -> None:
    (block,) = re.findall(r"^```sh\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = block.replace("\\\n", " ").splitlines()
    assert len(lines) == 4
    for line in lines:
        assert line.startswith("swarm ")
        words = [sys.executable, "-m", "laptop.cli", *line.split()[1:]]
        words += ["--json"] if "measure" in words else []
        done = subprocess.run(words, check=False, capture_output=True, text=True, cwd=tmp_path, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    given = dict(re.findall(r"(stay|host)=([0-9.]+)", block))
    for name, text in given.items():
        value = found["parameters"][name]
        assert value["low"] <= float(text) <= value["high"], found
        assert value["high"] <= 2.5 * value["low"], found
    assert [run["piconets"] for run in found["runs"]] == [1, 1, 2]
    for run in found["runs"]:
        assert run["radio"]["lost"] == 0
        assert run["radio"]["wrong"] == []
        assert run["model"]["pace"] == pytest.approx(run["radio"]["pace"], rel=0.3)
