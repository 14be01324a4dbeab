"""Real host processes on real buses, joined by a relay of this process in place of the mesh."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from swarm.bus import Bus
from swarm.codec import decode
from swarm.messages import AppProgress, AppState

NAMES = ("r0", "r1", "r2")
PATIENCE = 30.0


def config_text(names: Sequence[str] = NAMES, shape: str = "line", more: str = "") -> str:
    robots = "".join(
        f'[[robots]]\nname = "{name}"\nlink = "tcp:127.0.0.1:{4100 + i}"\n' for i, name in enumerate(names)
    )
    return f'network = "test"\n{robots}[topology]\nshape = "{shape}"\n[mesh]\ninsecure = true\n{more}'


class Rig:
    """One run directory with robots; everything it started ends with it."""

    def __init__(self, directory: Path, names: Sequence[str] = NAMES, more: str = "", shape: str = "line") -> None:
        self.directory = directory
        self.names = tuple(names)
        self.records = directory / "records"
        self.records.mkdir()
        (directory / "swarm.toml").write_text(config_text(names, shape, more))
        self.processes: dict[tuple[str, str], subprocess.Popen[bytes]] = {}
        self.buses: dict[str, Bus] = {}
        self.changed = threading.Condition()
        self.progress: dict[str, AppProgress] = {}
        self.state: dict[str, AppState] = {}
        for name in names:
            (directory / name).mkdir()
            self.start(name, "bus")
            bus = self.buses[name] = Bus.of(directory / name)
            bus.subscribe(f"swarm/{name}/app/*/progress", self._take(self.progress, name, AppProgress))
            bus.subscribe(f"swarm/{name}/app/*/state", self._take(self.state, name, AppState))

    def _take(self, where: dict[str, object], name: str, kind: type) -> Callable[[str, bytes], None]:
        def take(key: str, payload: bytes) -> None:
            with self.changed:
                where[name] = decode(kind, payload, key)
                self.changed.notify_all()

        return take

    def join(self, *edges: tuple[str, str]) -> None:
        """Carry the frames of the synchronous overlay both ways over each edge."""
        for a, b in edges:
            for here, there in ((a, b), (b, a)):
                out = self.buses[there]

                def carry(key: str, payload: bytes, out: Bus = out, there: str = there) -> None:
                    receiver = key.split("/")[6:]
                    if receiver in ([], [there]):
                        out.publish(key, payload, urgent=True)

                self.buses[here].subscribe(f"swarm/{here}/app/*/sync/**", carry)

    def start(self, robot: str, service: str, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        log = (self.directory / robot / f"{service}.log").open("ab")
        with log:
            process = subprocess.Popen(
                [sys.executable, "-m", f"services.{service}", *arguments],
                env={
                    **os.environ,
                    "SWARM_CONFIG": str(self.directory / "swarm.toml"),
                    "SWARM_ROBOT": robot,
                    "SWARM_RUNTIME": str(self.directory / robot),
                    "SWARM_RECORD": str(self.records),
                    "SWARM_PARENT": str(os.getpid()),
                    **environment,
                },
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self.processes[robot, service] = process
        return process

    def log(self, robot: str, service: str = "apps") -> str:
        return (self.directory / robot / f"{service}.log").read_text()

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for samples until `condition` holds."""
        with self.changed:
            if not self.changed.wait_for(condition, PATIENCE):
                logs = "\n".join(
                    f"{n}: {self.log(n)}" for n in self.names if (self.directory / n / "apps.log").exists()
                )
                pytest.fail(f"{what} did not happen within {PATIENCE:g} s: {self.progress}\n{logs}")

    def until_phase(self, phase: str, *names: str) -> None:
        wanted = names or self.names
        self.until(
            lambda: all(n in self.progress and self.progress[n].phase == phase for n in wanted), f"phase {phase}"
        )

    def rows(self, name: str, app: str = "consensus") -> dict[int, str]:
        """Recorded lines by iteration without the time; a line that stands there twice must be equal."""
        rows: dict[int, str] = {}
        for line in (self.records / f"{name}.{app}.csv").read_text().splitlines()[1:]:
            k, _, rest = line.split(",", 2)
            assert rows.setdefault(int(k), rest) == rest
        return rows

    def stop(self, robot: str, service: str = "apps") -> int:
        process = self.processes.pop((robot, service))
        process.terminate()
        return process.wait(10)

    def close(self) -> None:
        for process in self.processes.values():
            process.terminate()
        for bus in self.buses.values():
            bus.close()
        for process in self.processes.values():
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                print("STUCK", process.args)
                process.send_signal(6)
                process.wait()
                print("".join(f"{k} {self.log(*k)}" for k, v in self.processes.items() if v is process))
