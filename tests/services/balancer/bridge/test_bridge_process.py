"""The bridge as a process of the loop."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from balancer_rig import Rig
from loop_rig import VirtualLoop

from services.balancer.bridge import child
from services.balancer.bridge.child import Bridge
from swarm.messages import SetMode, Stop


@pytest.fixture
def bridge(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bridge]:
    """Its process stands still."""
    monkeypatch.setattr(child, "MODULE", "this")
    bridge = Bridge(0.0)
    os.kill(bridge.pid, signal.SIGSTOP)
    yield bridge
    if bridge.pid:
        os.kill(bridge.pid, signal.SIGKILL)
    bridge.close()


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


def test_a_stop_that_a_bridge_has_heard_in_its_last_moment_is_obeyed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The next bridge needs seconds to start before it hears the mesh repeat the stop."""
    (tmp_path / "ends.py").write_text("import os, sys; os.write(int(sys.argv[2]), b'stop')\n")
    monkeypatch.setattr(child, "MODULE", "ends")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    bridge = Bridge(0.0)
    try:
        os.waitid(os.P_PID, bridge.pid, os.WEXITED | os.WNOWAIT)
        bridge.keep_up(2.0)
        assert bridge.stop() == Stop(0.0, "", "")
    finally:
        bridge.close()


def test_a_bridge_that_begins_to_hang_is_ended_within_eight_seconds_and_another_one_started(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It hears no stop either. Nobody else watches it: systemd watches the loop."""
    (tmp_path / "hangs.py").write_text(
        "import os, signal, socket, sys\n"
        "telemetry = socket.socket(fileno=int(sys.argv[1]))\n"
        "telemetry.recv(10_000)\n"
        "os.kill(os.getpid(), signal.SIGSTOP)\n"
    )
    monkeypatch.setattr(child, "MODULE", "hangs")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    rig = Rig()
    bridge = Bridge(rig.now)
    try:
        first = bridge.pid
        assert bridge.send(SetMode("rest"))
        os.waitid(os.P_PID, first, os.WSTOPPED | os.WNOWAIT)
        bridge.keep_up(rig.now)
        loop = VirtualLoop(monkeypatch, rig, bridge)
        loop.run(round(100 * (child.HANG_S + 1.0)))
        assert os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None, "it may only be slow"
        loop.run(round(100 * (7.0 - child.HANG_S)))
        os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
        loop.run(100)
        assert bridge.pid not in (0, first)
        os.kill(bridge.pid, signal.SIGKILL)
    finally:
        bridge.close()


def test_a_bridge_that_is_still_loading_its_program_has_longer(bridge: Bridge) -> None:
    """On a Pi that boots the bridge shares the cores with all services that load Zenoh."""
    first = bridge.pid
    while bridge.send(SetMode("rest")):
        pass
    for now in (1.0, 1.0 + child.START_S):
        bridge.keep_up(now)
        assert os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None, "it may only be slow"
    bridge.keep_up(2.0 + child.START_S)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
    bridge.keep_up(3.0 + child.START_S)
    assert bridge.pid not in (0, first)


def test_a_bridge_that_takes_messages_now_and_then_is_kept(bridge: Bridge) -> None:
    for second in range(1, 10):
        assert bridge.send(SetMode("rest"))
        bridge.keep_up(2 * second * child.START_S)
    assert os.waitid(os.P_PID, bridge.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None
