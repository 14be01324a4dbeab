"""The processes of a simulated swarm: started, restarted as systemd would, ended with nothing left behind.

Each child dies with this process by PR_SET_PDEATHSIG (`swarm.process.edges.die_with_parent`), which the kernel ties to
the thread that started it: so everything here is called from the main thread only.
"""

import contextlib
import logging
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

from sim.control.power_switch import DISK
from swarm import clock
from swarm.errors import LocalError
from swarm.process.simulations import pid_file

RESTART_DELAY_S = 0.2
"""Seconds until a service is started again, as RestartSec in the units of deploy/systemd."""
START_LIMIT = 5
START_LIMIT_INTERVAL_S = 10.0
"""A service that ends this often within this time, s, is given up, as StartLimitBurst does."""
APP_FAULT = 3
NO_RESTART = (2, APP_FAULT)
"""Exit codes that a restart cannot mend: wrong configuration, fault of an app (RestartPreventExitStatus)."""

_log = logging.getLogger("sim")


@dataclass
class Child:
    """One service process of one robot."""

    robot: str
    service: str
    command: list[str]
    environment: dict[str, str]
    directory: Path
    process: subprocess.Popen[bytes] | None = None
    restarts: int = 0
    given_up: str = ""
    """Why it is not started again; empty while it is kept up."""
    exit_code: int | None = None
    """The exit code of its last end."""
    restart_at: float | None = None
    held: bool = False
    """Whether a request holds it: it is not started again until told to."""
    _ends: list[float] = field(default_factory=list)

    @property
    def log_file(self) -> Path:
        """Return the file of its output."""
        return self.directory / f"{self.service.replace('/', '.')}.log"

    def start(self) -> None:
        """Start the process and note its pid for `swarm hand kill`."""
        self.restart_at = None
        with self.log_file.open("ab") as log:
            self.process = subprocess.Popen(
                self.command,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # A group of its own: Ctrl-C at the terminal is for us alone, we end the others in order.
                process_group=0,
            )
        pid_file(self.directory.parent, self.robot, self.service).write_text(f"{self.process.pid}\n")

    def ended(self, code: int, now: float) -> None:
        """Decide what follows from the end of the process."""
        self.process = None
        self.exit_code = code
        self._ends = [at for at in self._ends if now - at < START_LIMIT_INTERVAL_S] + [now]
        if self.held:
            return
        if code in NO_RESTART:
            self.given_up = f"ended with code {code}"
        elif len(self._ends) >= START_LIMIT:
            self.given_up = f"ended {START_LIMIT} times within {START_LIMIT_INTERVAL_S:g} s"
        else:
            self.restart_at = now + RESTART_DELAY_S

    def hold(self) -> None:
        """End the process, and do not start it again."""
        self.held, self.restart_at = True, None
        if self.process is not None:
            self.process.terminate()
            self.process.send_signal(signal.SIGCONT)  # a stopped process would never see the other signal

    def release(self) -> None:
        """Start the process if it does not run, whatever went before. If it is still about to end, it starts after
        that."""
        self.held, self.given_up, self._ends = False, "", []
        if self.process is None and self.restart_at is None:
            self.start()

    def last_words(self, lines: int = 3) -> str:
        """Return the last lines of its log."""
        with contextlib.suppress(OSError):
            return "\n".join(self.log_file.read_text(errors="replace").splitlines()[-lines:])
        return ""


class Processes:
    """All service processes of the run."""

    def __init__(self, environment: dict[str, str]) -> None:
        """`environment` is what all children get beside this process' own."""
        self._environment = {**os.environ, **environment, "SWARM_PARENT": str(os.getpid())}
        self.children: list[Child] = []

    def add(self, robot: str, service: str, arguments: list[str], directory: Path) -> None:
        """Start `python -P -m arguments` as `service` of `robot`, whose runtime directory is `directory`.

        With -P nothing in the folder in which a user has typed the command takes the place of one of our modules.
        """
        own = {"SWARM_ROBOT": robot, "SWARM_RUNTIME": str(directory), "SWARM_STATE": str(directory / DISK)}
        environment = {**self._environment, **own}
        child = Child(robot, service, [sys.executable, "-P", "-m", *arguments], environment, directory)
        try:
            child.start()
        except OSError as error:
            raise LocalError(f"{robot} {service} cannot be started: {error}") from None
        self.children.append(child)

    def of(self, robot: str) -> list[Child]:
        """Return the processes of one robot."""
        return [child for child in self.children if child.robot == robot]

    def find(self, robot: str, service: str) -> Child | None:
        """Return the process of a robot's service; None where there never was one."""
        return next((child for child in self.of(robot) if child.service == service), None)

    def kill(self, robot: str) -> None:
        """End all processes of one robot at once, as when its power fails; they stay away until `start`."""
        for child in self.of(robot):
            if child.process is not None:
                child.process.kill()
        for child in self.of(robot):
            if child.process is not None:
                child.process.wait()
                child.process = None
            child.restart_at = None

    def end(self, robot: str, service: str) -> bool:
        """End the process of a robot's service at once; it is started again. Return False where it does not run."""
        child = self.find(robot, service)
        if child is None or child.process is None or child.process.poll() is not None:
            return False
        child.process.kill()
        child.process.wait()  # a second call finds that it has ended, also before `supervise` does
        return True

    def start(self, robot: str) -> None:
        """Boot a robot that `kill` has ended. Earlier ends of its services do not count any more."""
        for child in self.of(robot):
            child.release()

    def supervise(self, now: float) -> list[Child]:
        """Restart what ended, after its delay; returns those given up since the last call."""
        lost = []
        for child in self.children:
            if child.process is not None:
                code = child.process.poll()
                if code is None:
                    continue
                child.ended(code, now)
                _log.info("%s %s ended code=%s", child.robot, child.service, code)
                if child.given_up:
                    lost.append(child)
            elif child.restart_at is not None and now >= child.restart_at:
                try:
                    child.start()
                    child.restarts += 1
                except OSError as error:
                    child.given_up = f"cannot be started: {error}"
                    lost.append(child)
        return lost

    def stop(self, grace_s: float = 3.0) -> None:
        """End all processes. A process that does not end when asked is killed. Apps end before the services that they
        use are asked, or their recordings would end with links that go down because the run is over."""
        running = [(child.service, child.process) for child in reversed(self.children) if child.process is not None]
        _end([process for service, process in running if service.startswith("app/")], grace_s)
        _end([process for service, process in running if not service.startswith("app/")], grace_s)


def _end(running: list[subprocess.Popen[bytes]], grace_s: float) -> None:
    for process in running:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
            process.send_signal(signal.SIGCONT)  # a stopped process would never see the other signal
    deadline = clock.now() + grace_s
    for process in running:
        try:
            process.wait(max(0.0, deadline - clock.now()))
        except subprocess.TimeoutExpired:
            _log.warning("killed pid=%s: it did not stop within %g s", process.pid, grace_s)
            process.kill()
            process.wait()
