"""Four robots on a line for `bench.stop.stop`: r0 with a simulated body that tells the truth, and an operator's page.

The links have the latency and bandwidth of the thesis. The operator reaches r0 through a stand-in for ssh: a script
that runs the command on this machine, with r0's environment.
"""

import contextlib
import os
import random
import shlex
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from bench.rigs.running import robots_folder
from bench.stop.body import TRUTH
from bench.stop.page import Page
from laptop.fleet.ssh.ssh import Host, Ssh
from laptop.view.actions.control import Control
from laptop.view.actions.robot_actions import PageAction
from laptop.view.feeds.robots import Robots
from sim.devices.world_client import WORLD_SOCKET
from sim.processes.processes import Processes
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.config import load
from swarm.errors import LocalError
from swarm.messages import Arm, BalancerState, SetMode, Stop, Stopped, read
from swarm.messages.codec import Value
from swarm.messages.keys import STOP, key

NAMES = ("r0", "r1", "r2", "r3")
FAULT, MOVING = "fault", ("standing_up", "balancing")

CONFIG = """network = "bench"
[topology]
shape = "line"
[mesh]
insecure = true
"""
ROBOT = """[[robots]]
name = "{name}"
link = "sim:{home}/{name}/mesh.sock"
"""

SSH = """#!/bin/sh
for command; do :; done
command=$(printf %s "$command" | sed -e 's#^sudo -n ##' -e 's#SWARM_RUNTIME=[^ ]*#SWARM_RUNTIME={home}/r0#' \\
    -e 's#/opt/swarm/current/bin/swarm#{python} -m {program}#' -e 's#/opt/swarm/current/bin/python#{python}#')
export SWARM_ROBOT=r0 SWARM_RUNTIME={home}/r0 SWARM_CONFIG={home}/swarm.toml
exec sh -c "exec $command"
"""
"""A stand-in for ssh: its last argument is the command that r0 is to run."""

START_S = 60.0
UP_S = 60.0
"""s within which a robot is up again after a stop: it may need several tries."""
ANSWER_S = 0.5
"""s after which an order is given again."""
LOST_S = 10.0
"""s after which a stop without effect counts as lost."""
MOST_FALLS = 10
"""Stops in turn before which the robot may fall by itself; such a stop is given again."""
LONGEST_PAUSE_S = 0.04
"""A stop comes at any time of the ticks (10 ms) and of the telemetry (40 ms)."""

T = TypeVar("T")


class NoActions:
    """What a page may do besides stopping: nothing."""

    acts: Mapping[str, PageAction] = {}

    def give(self, robots: Sequence[str], app: str, values: Mapping[str, Value]) -> list[str]:
        """Nothing is near."""
        return list(robots)

    def close(self) -> None:
        """There is nothing under way."""


class RobotsOnALine:
    """The processes, what they say, and the operator's page. A context."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self.home = Path(self._stack.enter_context(robots_folder()))
        self._heard = threading.Condition()
        self._off: float | None = None
        self._driven = False
        self._mode = ""
        self._said: tuple[float, str] = 0.0, ""
        self._stopped: dict[str, bool] = {}
        self._given: list[float] = []
        self._random = random.Random(1)
        try:
            self._start()
        except BaseException:
            self._stack.close()
            raise

    def _start(self) -> None:
        config = self.home / "swarm.toml"
        config.write_text(CONFIG + "".join(ROBOT.format(name=name, home=self.home) for name in NAMES))
        self._listen(self.home / "truth", self._take_truth)
        self._listen(self.home / WORLD_SOCKET, lambda data: None)  # nobody asks where the body is
        environment = {
            "SWARM_CONFIG": str(config),
            "SWARM_SIM_LINK": "latency=0.03,bandwidth=78000",
            "SWARM_SIM_LYING": "front",
        }
        processes = Processes(environment)
        self._stack.callback(processes.stop)
        for name in NAMES:
            (self.home / name).mkdir()
            for service in ("bus", "mesh"):
                processes.add(name, service, [f"services.{service}"], self.home / name)
        processes.add("r0", "balancer", ["bench.stop.body", str(self.home / "truth")], self.home / "r0")
        self.buses = {name: self._stack.enter_context(Bus.of(self.home / name)) for name in ("r0", "r3")}
        for bus in self.buses.values():
            bus.subscribe(key("*", "mesh", "stopped"), self._take_stopped)
        self.buses["r0"].subscribe([STOP, key("r0", "balancer", "state")], self._take)
        self._wait(lambda: self._mode == "idle", START_S, "r0's balancer is ready")
        self._await_links()
        self._write_ssh("laptop.cli")
        self.ssh, self.host = Ssh(named=False), Host("r0", "r0")
        self.view = Robots(load(config), [self.host], self.ssh)
        self._stack.callback(self.view.close)
        self.page = self._stack.enter_context(Page(self.view, Control(self.view, NoActions())))

    def __enter__(self) -> "RobotsOnALine":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def environment(self, robot: str) -> dict[str, str]:
        """Of a process on a robot."""
        own = {
            "SWARM_ROBOT": robot,
            "SWARM_RUNTIME": str(self.home / robot),
            "SWARM_CONFIG": str(self.home / "swarm.toml"),
        }
        return {**os.environ, **own, "SWARM_PARENT": str(os.getpid())}

    def program(self, module: str) -> None:
        """Which program is `swarm` on r0, for who comes by ssh."""
        self._write_ssh(module)

    def stop(self, give: Callable[[], float | None]) -> tuple[float, float, float] | None:
        """Have r0 stand up, and stop it: s from the stop to motors off, from there until `balancer/state` says so, and
        from the call of `give` to the stop. None where the stop is lost.

        `give` gives the stop and returns when it did, or None where the time in the message tells.
        """
        for _ in range(MOST_FALLS):
            self._stand_up()
            time.sleep(self._random.uniform(0.0, LONGEST_PAUSE_S))
            with self._heard:
                self._off, self._given, self._said = None, [], (0.0, "")
                if not self._moves():
                    continue
            began = clock.now()
            known = give()
            try:
                self._wait(lambda: self._off is not None and self._said[1] == FAULT, LOST_S, "r0 stops")
            except LocalError:
                return None
            with self._heard:
                # The mesh repeats a stop: the first one is meant.
                given = known if known is not None else min((at for at in self._given if at >= began), default=None)
                if given is None or self._off is None:
                    return None
                if self._off >= given:  # otherwise it has fallen by itself, and there was nothing left to stop
                    return self._off - given, self._said[0] - self._off, given - began
        raise LocalError(f"bench stop: r0 fell by itself before each of {MOST_FALLS} stops")

    def _moves(self) -> bool:
        return self._driven and self._mode in MOVING

    def _await_links(self) -> None:
        """Stop the swarm on r3 until r0 hears of it."""
        end = clock.now() + START_S
        while True:
            self.buses["r3"].publish(STOP, Stop(clock.now(), "bench", "whether the line is whole"))
            try:
                return self._wait(lambda: self._stopped.get("r0"), ANSWER_S, "a stop on r3 reaches r0")
            except LocalError:
                if clock.now() > end:
                    raise

    def _stand_up(self) -> None:
        end = clock.now() + UP_S
        while True:
            for name, bus in self.buses.items():
                bus.publish(key(name, "mesh", "set", "arm"), Arm(clock.now(), "bench"), urgent=True)
            with contextlib.suppress(LocalError):
                self._wait(lambda: not any(self._stopped.values()), ANSWER_S, "armed")
                self.buses["r0"].publish(key("r0", "balancer", "set", "mode"), SetMode("stand"))
                self._wait(self._moves, 4 * ANSWER_S, "r0 moves")
                return
            if clock.now() > end:
                raise LocalError(f"bench stop: r0 does not stand up again: {self._mode}, stopped {self._stopped}")

    def _take(self, name: str, payload: bytes) -> None:
        message = read(name, payload)
        with self._heard:
            if isinstance(message, BalancerState):
                if message.mode != self._said[1]:
                    self._said = clock.now(), message.mode
            elif isinstance(message, Stop):
                self._given.append(message.t)
            self._heard.notify_all()

    def _take_stopped(self, name: str, payload: bytes) -> None:
        message = read(name, payload)
        if isinstance(message, Stopped):
            with self._heard:
                self._stopped[name.split("/")[1]] = message.stopped
                self._heard.notify_all()

    def _take_truth(self, data: bytes) -> None:
        at, driven = TRUTH.unpack_from(data)
        mode = data[TRUTH.size :].decode()
        with self._heard:
            if mode == FAULT and not driven and self._off is None:
                self._off = at
            self._driven, self._mode = driven, mode
            self._heard.notify_all()

    def _wait(self, condition: Callable[[], T], seconds: float, what: str) -> None:
        with self._heard:
            if not self._heard.wait_for(condition, seconds):
                raise LocalError(f"bench stop: not within {seconds:g} s: {what}")

    def _listen(self, path: Path, take: Callable[[bytes], None]) -> None:
        """Take the datagrams that come to a socket, in a thread."""
        end = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        end.bind(str(path))

        def run() -> None:
            while data := end.recv(1024):
                take(data)

        thread = threading.Thread(target=run, name=path.name)
        thread.start()

        def close() -> None:
            end.shutdown(socket.SHUT_RDWR)
            thread.join()
            end.close()

        self._stack.callback(close)

    def _write_ssh(self, program: str) -> None:
        folder = self.home / "bin"
        if not folder.is_dir():
            folder.mkdir()
            path = os.environ["PATH"]
            os.environ["PATH"] = f"{folder}:{path}"
            self._stack.callback(os.environ.__setitem__, "PATH", path)
        new = folder / "ssh.new"
        new.write_text(SSH.format(home=self.home, python=shlex.quote(sys.executable), program=program))
        new.chmod(0o755)
        new.replace(folder / "ssh")
