"""Inside a machine: the mesh and app processes of its robots, an adapter each."""

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from conftest import Processes

from lab.inside import PYTHON
from lab.shapes import ROBOTS
from lab.waiting import WaitedInVainError, until
from swarm.app.overlays import Overlays
from swarm.bus.zenoh_bus import Bus, Router
from swarm.messages import Links, read
from swarm.process.paths import bus_endpoint

NAMES = [f"r{i}" for i in range(ROBOTS)]
SHARE = Path("/share")
MESH, APPS = "services.mesh", "services.apps"


class Swarm:
    """Services of the robots here, with buses of this process; a killed one is started again, as systemd does."""

    def __init__(
        self,
        processes: Processes,
        config: str,
        names: Sequence[str] = NAMES,
        *,
        state: Path | None = None,
    ) -> None:
        """`config`: the name of its swarm.toml in the shared folder, without the suffix; `names`: those here; `state`:
        a folder for what survives a reboot."""
        self.processes = processes
        self.config = config
        self.names = names
        self.records = processes.runtime / "records"
        self.records.mkdir()
        self.state = state
        self.routers: list[Router] = []
        self.buses: dict[str, Bus] = {}
        self.reached: dict[str, int] = dict.fromkeys(names, -1)
        """The latest iteration of each robot."""
        self.links: dict[str, Links] = {}
        """What each mesh has told of its links last, by key."""
        self.fork_server = processes.start(str(Path(__file__).with_name("inside_fork_server.py")), program=PYTHON)
        for name in self.names:
            directory = processes.runtime / name
            directory.mkdir()
            self.routers.append(Router(bus_endpoint(directory)))
            self.buses[name] = Bus.of(directory)
            self.buses[name].subscribe(f"swarm/{name}/app/*/state", self._on_state)
            self.buses[name].subscribe(f"swarm/{name}/mesh/links", self._on_links)

    def _on_state(self, key: str, payload: bytes) -> None:
        self.reached[key.split("/")[1]] = read(key, payload).k

    def _on_links(self, key: str, payload: bytes) -> None:
        self.links[key] = read(key, payload)

    def start(self, module: str, name: str, *words: str, config: str = "") -> int:
        """The process id of a service that has begun to start."""
        environment = {
            "SWARM_ROBOT": name,
            "SWARM_RUNTIME": str(self.processes.runtime / name),
            "SWARM_CONFIG": str(SHARE / f"{config or self.config}.toml"),
            "SWARM_RECORD": str(self.records),
        }
        if self.state is not None:
            environment["SWARM_STATE"] = str(self.state)
        order = json.dumps({"environment": environment, "module": module, "words": words})
        stdin, stdout = self.fork_server.stdin, self.fork_server.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(order + "\n")
        stdin.flush()
        return int(stdout.readline())

    def start_meshes(self) -> None:
        for name in self.names:
            self.start(MESH, name)

    def run(self, iterations: int) -> None:
        self.start_meshes()
        for name in self.names:
            self.start(APPS, name, "consensus", "--iterations", str(iterations), "--run", "1ab")

    def kill(self, module: str, name: str) -> int:
        """By -9: the process id that is no more."""
        process = self.process(module, name)
        os.kill(process, signal.SIGKILL)
        return process

    def process(self, module: str, name: str) -> int:
        """The id of the process that is it now."""
        return int((self.processes.runtime / name / f"{module}.pid").read_text())

    def ask(self, name: str, topic: str) -> Any:
        """What that robot's mesh answers."""
        answers: list[Any] = []

        def asked() -> bool:
            key = f"swarm/{name}/mesh/{topic}"
            self.buses[name].ask(key, lambda key, payload: answers.append(read(key, payload)), timeout_s=2.0)
            return bool(answers)

        self.wait(f"{name}'s mesh answers about {topic}", asked)
        return answers[0]

    def wait(self, what: str, condition: Callable[[], bool], state: Callable[[], object] = str) -> None:
        """Wait until `condition()`; `what` describes it, `state()` returns what is so now."""
        try:
            until(what, condition, state=lambda: f"{self.logs()}\niterations {self.reached}; {state()}")
        except WaitedInVainError as error:
            raise WaitedInVainError(f"{error}\n{self.told()}") from None

    def told(self) -> str:
        """What the services answer about themselves, counters and progress, and how the links are, by key."""
        answers = dict(self.links)
        for name, bus in self.buses.items():
            for topic in ("mesh/status", "app/*/status", "app/*/progress"):
                bus.ask(
                    f"swarm/{name}/{topic}",
                    lambda key, payload: answers.setdefault(key, read(key, payload)),
                    timeout_s=2.0,
                )
        time.sleep(2.5)  # the answers of services that answer; nothing tells that there is none
        return "\n".join(f"{key}: {answer}" for key, answer in sorted(answers.items()))

    def wait_reached(self, what: str, iteration: int) -> None:
        """Wait until all robots have done that iteration."""
        self.wait(f"all at iteration {iteration}, {what}", lambda: min(self.reached.values()) >= iteration)

    def end_services(self) -> None:
        """Meshes and apps, not what has started them."""
        running = [Path(f"/proc/{self.process(module, name)}") for module in (APPS, MESH) for name in self.names]
        for process in running:
            os.kill(int(process.name), signal.SIGTERM)
        self.wait(f"{running} end after SIGTERM", lambda: not any(process.exists() for process in running), self.stacks)

    def end(self) -> None:
        """All services end by SIGTERM, and well."""
        stdin = self.fork_server.stdin
        assert stdin is not None
        stdin.close()
        self.wait("all services end after SIGTERM", lambda: self.fork_server.poll() is not None, self.stacks)
        assert self.fork_server.returncode == 0, self.logs()

    def stacks(self) -> str:
        """Have each service that still runs write to its log where its threads are; return which ones run."""
        running = {}
        for file in sorted(self.processes.runtime.glob("*/*.pid")):
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(file.read_text()), signal.SIGUSR1)
                running[f"{file.parent.name} {file.stem}"] = file.read_text()
        return f"still running: {running}"

    def logs(self) -> str:
        """What the services have said last."""
        return "\n".join(f"{log}: {log.read_text()[-4000:]}" for log in sorted(self.processes.runtime.glob("*/log")))

    def close(self) -> None:
        self.processes.end()
        for bus in self.buses.values():
            bus.close()
        for router in self.routers:
            router.close()


def come(each: Overlays, count: int) -> list[tuple[str, bytes, bool]]:
    """(sender, payload, flooded) of what has come: so many, and whatever came too much."""
    got: list[tuple[str, bytes, bool]] = []

    def enough() -> bool:
        got.extend(tuple(message) for message in each.messages())
        return len(got) >= count

    until(f"{count} messages come", enough, state=lambda: got)
    time.sleep(0.2)
    enough()
    return got
