"""Runs `swarm sim` as a user does: start it, lay hands on it, read what it found."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from bench.rigs.running import robots_folder
from laptop.cli.hand import end_service
from swarm.errors import LocalError
from swarm.recording.reader import SUFFIX
from swarm.recording.trajectory import Trajectory, TrajectoryReader

POLL_S = 0.02
START_S = 300.0
"""So long at most an app may take to its first iteration. The simulation gives itself up before, where its start does
not go on; the 36 processes of six robots take a busy machine more than a minute."""
SWARM_SIM = ("laptop.cli", "sim")


Start = Callable[..., "subprocess.Popen[str]"]


class SimulationError(Exception):
    """The simulation ended with a non-zero code; holds the end of what it said."""


class Simulation:
    """One `swarm sim ARGUMENTS --json`, in directories of its own that go with it. A context."""

    def __init__(
        self,
        *arguments: str,
        program: Sequence[str] = SWARM_SIM,
        run_dir: Path | None = None,
        start: Start = subprocess.Popen,
    ) -> None:
        """`program`: module, and its first arguments, that does what `swarm sim` does; `run_dir`: another's; `start`
        starts it."""
        self._folder = robots_folder(ignore_cleanup_errors=True)  # services of one that was killed end a moment later
        self._home = Path(self._folder.name)
        self.run_dir = run_dir or self._home / "run"
        self.records = self._home / "records"
        self._readers: dict[Path, TrajectoryReader] = {}
        self._error = (self._home / "stderr").open("w+")
        own = ["--json", "--run-dir", str(self.run_dir), "--record", str(self.records)]
        command = [sys.executable, "-m", *program, *arguments, *own]
        self.process = start(command, stdout=subprocess.PIPE, stderr=self._error, text=True)

    def __enter__(self) -> "Simulation":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._error.close()
        self._folder.cleanup()

    def stop(self) -> None:
        """End it; its recordings are complete then."""
        if self.process.poll() is None:
            self.process.terminate()
        if self.process.stdout is not None and not self.process.stdout.closed:
            self.process.communicate()

    def trajectory(self, robot: str, app: str = "consensus") -> Trajectory:
        """What a robot has recorded so far."""
        path = self.records / f"{robot}.{app}{SUFFIX}"
        return self._readers.setdefault(path, TrajectoryReader(path)).read()

    def wait_for(self, robot: str, k: int, app: str = "consensus", timeout_s: float = 60.0) -> None:
        """Wait until a robot has reached iteration k. Raises `SimulationError` where the simulation ends before, or the
        robot has done nothing for `timeout_s` (`START_S` until it has begun)."""
        before, since = -1, time.monotonic()
        while (last := self.trajectory(robot, app).last) < k:
            if last > before:
                before, since = last, time.monotonic()
            if self.process.poll() is not None or time.monotonic() > since + (timeout_s if last >= 0 else START_S):
                raise SimulationError(f"{robot} did not reach iteration {k}, but {last}: {self.said()}")
            time.sleep(POLL_S)

    def kill(self, robot: str, service: str, name: str = "KILL") -> None:
        """`swarm hand kill`, at once: a command takes a second to start. Raises `SimulationError`."""
        try:
            end_service(self.run_dir / robot, service, name)
        except LocalError as error:
            raise SimulationError(f"{error}: {self.said()}") from None

    def finish(self, timeout_s: float = 180.0) -> dict[str, object]:
        """Wait for the end, which may have come by Ctrl-C; the object of `--json`. Raises `SimulationError` when it
        failed."""
        output, _ = self.process.communicate(timeout=timeout_s)
        if self.process.returncode not in (0, 128 + signal.SIGINT):
            raise SimulationError(f"code {self.process.returncode}\n{output[-500:]}\n{self.said()}")
        result: dict[str, object] = json.loads(output)
        return result

    def said(self) -> str:
        """The end of what it wrote on stderr."""
        return Path(self._error.name).read_text()[-1500:]


def simulate(*arguments: str, program: Sequence[str] = SWARM_SIM, start: Start = subprocess.Popen) -> dict[str, object]:
    """Run a simulation to its end; the object of `--json`."""
    with Simulation(*arguments, program=program, start=start) as simulation:
        return simulation.finish()
