"""The bridge as a process of the loop."""

import time
from pathlib import Path

import pytest

from services.balancer.bridge import child
from services.balancer.bridge.child import Bridge


def test_the_bridge_is_ended_before_the_loop_where_memory_runs_out_from_its_first_moment(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It has its score when its program begins, which then takes memory: the loop's own would be the same."""
    (tmp_path / "tells.py").write_text(
        "from pathlib import Path\n"
        f"Path({str(tmp_path / 'new')!r}).write_text(Path('/proc/self/oom_score_adj').read_text())\n"
        f"Path({str(tmp_path / 'new')!r}).rename({str(tmp_path / 'score')!r})\n"
    )
    monkeypatch.setattr(child, "MODULE", "tells")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    bridge = Bridge(0.0)
    try:
        deadline = time.monotonic() + 30.0
        while not (tmp_path / "score").exists():
            assert time.monotonic() < deadline, "the process has not told its score within 30 s"
            time.sleep(0.01)
    finally:
        bridge.close()
    assert (tmp_path / "score").read_text().strip() == child.OOM_SCORE_ADJUST
