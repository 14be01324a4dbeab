"""The rehearsal of a calibration in docs/how-to/robots/calibrate.md: its three commands, as they stand there."""

import re
import shlex
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from conftest import wait_until

from bench.rigs.running import running
from services.dwm.core.calibration import calibration_file
from swarm.process.simulations import default_run_dir, is_live

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/how-to/robots/calibrate.md").read_text(encoding="utf-8").replace("\\\n", " ")
BLOCK = re.compile(r"```sh rehearsal\n(swarm sim .*)\n(swarm calibrate .*)\n(swarm hand place r0) .*\n```")
START = re.compile(r"place \d+ of \d+: \((\S+), (\S+)\) m, heading 0 degrees: start\?")


def started(command: str, folder: Path) -> "AbstractContextManager[subprocess.Popen[str]]":
    """A command that is ended with the block."""
    words = [sys.executable, "-m", "laptop.cli", *shlex.split(command, comments=True)[1:]]
    pipe = subprocess.PIPE
    return running(words, cwd=folder, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_calibration_is_rehearsed_on_a_simulated_robot(
    tmp_path: Path, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot stays where a hand has put it, so the fit is taken; the person starts as soon as it is there."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    found = BLOCK.search(PAGE)
    assert found is not None, "the block of the rehearsal"
    with started(found[1], tmp_path) as simulation:
        assert simulation.stdin is not None
        wait_until(lambda: is_live(default_run_dir()) and list(default_run_dir().glob("r0/body.sock")), 60)
        with started(found[2], tmp_path) as session:
            assert session.stdin is not None
            assert session.stdout is not None
            said = []
            for line in session.stdout:
                said.append(line)
                if (asked := START.match(line)) is not None:
                    with started(f"{found[3]} {asked[1]} {asked[2]}", tmp_path) as hand:
                        assert "lies on its back" in hand.communicate(timeout=60)[0]
                    session.stdin.write("\n")
                    session.stdin.flush()
            assert session.wait(60) == 0, "".join(said)
    file = calibration_file.parse((tmp_path / "r0.toml").read_text(), "r0.toml")
    assert file.distance is not None
    assert file.distance[1].nested < 0.8 * file.distance[1].left_out["raw"]
