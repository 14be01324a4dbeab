"""Real host processes on real buses, joined by a relay of this process in place of the mesh."""

import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import fork_server
import pytest

from swarm.bus.zenoh_bus import Bus, Router
from swarm.core.lockstep.actions import address_of
from swarm.messages import AppEpoch, AppProgress, AppState, Topology
from swarm.messages.codec import decode, encode
from swarm.process.paths import bus_endpoint
from swarm.recording import trajectory

NAMES = ("r0", "r1", "r2")
PATIENCE = 60.0


def config_text(names: Sequence[str] = NAMES, more: str = "", shape: str = "line") -> str:
    robots = [f'[[robots]]\nname = "{name}"\nlink = "tcp:127.0.0.1:{4100 + i}"\n' for i, name in enumerate(names)]
    return f'network = "test"\n{"".join(robots)}[topology]\nshape = "{shape}"\n[mesh]\ninsecure = true\n{more}'


class Rig:
    """One run directory with robots; everything it started ends with it.

    The relay drops frames of iterations beyond `gate`, so that a test finds the swarm where it wants it.
    """

    def __init__(
        self, directory: Path, names: Sequence[str] = NAMES, more: str = "", own_bus: Sequence[str] = ()
    ) -> None:
        """The buses are of this process, but for robots of `own_bus`: theirs can be killed."""
        self.directory = directory
        self.names = tuple(names)
        self.gate = 2**32
        self.silent = False
        """Whether nothing passes but what goes around links."""
        self.version, self.edges = 0, list(itertools.pairwise(names))
        self.records = directory / "records"
        self.records.mkdir()
        (directory / "swarm.toml").write_text(config_text(names, more))
        self.processes: dict[tuple[str, str], subprocess.Popen[bytes]] = {}
        self.routers: list[Router] = []
        self.buses: dict[str, Bus] = {}
        self.changed = threading.Condition()
        self.progress: dict[str, AppProgress] = {}
        self.state: dict[str, AppState] = {}
        self.epochs: dict[str, AppEpoch] = {}
        self.told: dict[str, AppProgress] = {}
        """By key: what every app and channel has told last."""
        for name in names:
            (directory / name).mkdir()
            if name in own_bus:
                self.start(name, "bus")
            else:
                self.routers.append(Router(bus_endpoint(directory / name)))
            bus = self.buses[name] = Bus.of(directory / name)
            bus.subscribe(f"swarm/{name}/app/*/progress", self._take(self.progress, name, AppProgress))
            bus.subscribe(f"swarm/{name}/app/**/progress", self._keep)
            bus.subscribe(f"swarm/{name}/app/*/epoch", self._take(self.epochs, name, AppEpoch))
            bus.subscribe(f"swarm/{name}/app/*/state", self._take(self.state, name, AppState))
            bus.serve(f"swarm/{name}/mesh/topology", lambda *_, name=name: encode(self.topology(name)))  # type: ignore[misc]
        for here, there in itertools.pairwise(names):
            self._relay(here, there)
            self._relay(there, here)

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            process.kill()
        for bus in self.buses.values():
            bus.close()
        for router in self.routers:
            router.close()
        for process in self.processes.values():
            process.wait()

    def start(self, robot: str, service: str, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        return self.launch(robot, service, ["-m", f"services.{service}", *arguments], **environment)

    def launch(self, robot: str, name: str, command: Sequence[str], **environment: str) -> subprocess.Popen[bytes]:
        """Start a Python process of a robot; it is known by `name`."""
        own = {
            "SWARM_CONFIG": str(self.directory / "swarm.toml"),
            "SWARM_ROBOT": robot,
            "SWARM_RUNTIME": str(self.directory / robot),
            "SWARM_RECORD": str(self.records),
            "SWARM_PARENT": str(os.getpid()),
        }
        with (self.directory / robot / f"{name}.log").open("ab") as log:
            process = fork_server.start(
                [sys.executable, *command],
                env={**os.environ, **own, **environment},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self.processes[robot, name] = process
        return process

    def topology(self, name: str) -> Topology:
        """What a robot's mesh would tell."""
        near = tuple(sorted(b if a == name else a for a, b in self.edges if name in (a, b)))
        return Topology(0.0, self.version, 0, "", False, 0.0, tuple(self.edges), near, near, (), {})

    def set_topology(self, *edges: tuple[str, str]) -> None:
        """Another topology is in force; this rig's relay goes on as it was."""
        self.version, self.edges = self.version + 1, list(edges)
        for name, bus in self.buses.items():
            bus.publish(f"swarm/{name}/mesh/topology", self.topology(name))

    def start_all(self, *arguments: str, **environment: str) -> None:
        for name in self.names:
            self.start(name, "apps", *arguments, **environment)

    def kill(self, robot: str, service: str = "apps") -> None:
        process = self.processes.pop((robot, service))
        process.send_signal(signal.SIGKILL)
        process.wait()

    def stop(self, robot: str, service: str = "apps") -> int:
        process = self.processes.pop((robot, service))
        process.terminate()
        return process.wait(PATIENCE)

    def log(self, robot: str, service: str = "apps") -> str:
        path = self.directory / robot / f"{service}.log"
        return path.read_text() if path.exists() else ""

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until `condition` holds; it is looked at with every message of an app."""
        with self.changed:
            if not self.changed.wait_for(condition, PATIENCE):
                logs = "\n".join(f"{name}: {self.log(name)}" for name in self.names)
                pytest.fail(f"{what} did not happen within {PATIENCE:g} s: {self.progress}\n{logs}")

    def until_phase(self, phase: str, *names: str) -> None:
        wanted = names or self.names
        self.until(
            lambda: all(n in self.progress and self.progress[n].phase == phase for n in wanted), f"phase {phase}"
        )

    def until_waits(self, robot: str, *peers: str) -> None:
        """Wait until `robot` says that it waits for `peers`."""

        def waits() -> bool:
            progress = self.progress.get(robot)
            return progress is not None and (progress.phase, progress.waiting_for) == ("waiting", peers)

        self.until(waits, f"naming {peers}")

    def until_k(self, k: int, *names: str) -> None:
        wanted = names or self.names
        self.until(lambda: all(n in self.state and self.state[n].k >= k for n in wanted), f"iteration {k}")

    def rows(self, name: str, app: str = "consensus") -> dict[int, str]:
        """Recorded states and results by iteration, the time before them; one that stands there twice is equal."""
        found = trajectory.read(self.records / f"{name}.{app}.mcap")
        return {k: ",".join((repr(found.times[k]), *row)) for k, row in found.rows.items()}

    def values(self, name: str, app: str = "consensus") -> list[str]:
        """The recorded states and results in order, without k and t."""
        rows = self.rows(name, app)
        assert sorted(rows) == list(range(len(rows)))
        return [rows[k].split(",", 1)[1] for k in range(len(rows))]

    def _keep(self, key: str, payload: bytes) -> None:
        with self.changed:
            self.told[key] = decode(AppProgress, payload, key)
            self.changed.notify_all()

    def _take(self, where: dict[str, Any], name: str, kind: type) -> Callable[[str, bytes], None]:
        def take(key: str, payload: bytes) -> None:
            with self.changed:
                where[name] = decode(kind, payload, key)
                self.changed.notify_all()

        return take

    def _relay(self, here: str, there: str) -> None:
        def carry(key: str, payload: bytes) -> None:
            address = address_of(key)
            assert address is not None
            crosses = address.to in (None, there) and address.around == self.silent
            if crosses and int.from_bytes(payload[1:5], "little") <= self.gate:
                self.buses[there].publish(key, payload, urgent=True)

        self.buses[here].subscribe(f"swarm/{here}/app/*/sync/**", carry)
        latest = self.buses[there].publish
        self.buses[here].subscribe(
            f"swarm/{here}/app/*/latest/*", lambda key, payload: latest(key, payload, urgent=True)
        )
