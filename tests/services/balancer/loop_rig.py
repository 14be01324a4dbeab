"""The balancer's loop on a virtual clock, with a bridge made of lists."""

import math
from types import SimpleNamespace

import pytest
from balancer_rig import Rig

from services.balancer import loop as loop_module
from services.balancer.bridge.child import Bridge
from services.balancer.bridge.link import pack, unpack
from services.balancer.loop import Loop
from services.balancer.slack_tasks import SlackTasks
from services.balancer.telemetry import Telemetry
from swarm.messages import Stop


class Lists:
    """In place of the bridge process."""

    def __init__(self) -> None:
        self.sent: list = []
        self.incoming: list = []
        self.heard = math.inf
        """When the commands were heard by the bridge."""
        self.looks = 0

    def send(self, message) -> bool:
        self.sent.append(unpack(pack(message)))
        return True

    def stop(self) -> Stop | None:
        stops = [message for message in self.incoming if isinstance(message, Stop)]
        self.incoming = [message for message in self.incoming if not isinstance(message, Stop)]
        return stops[0] if stops else None

    def commands(self) -> list:
        taken, self.incoming = self.incoming, []
        return [(self.heard, message) for message in taken]

    def keep_up(self, now: float, *, stopped: bool = False) -> None:
        self.looks += 1

    def of(self, kind: type) -> list:
        return [message for message in self.sent if isinstance(message, kind)]


class VirtualLoop:
    """A loop that ends after a number of sleeps; `oversleep` says by how much each one is too long."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, rig: Rig | None = None, bridge: Bridge | Lists | None = None
    ) -> None:
        self.rig = rig or Rig()
        self.bridge = bridge or Lists()
        balancer = self.rig.balancer
        self.loop = Loop(balancer, Telemetry(balancer, "lqr"), SlackTasks(balancer, self.rig.clock), self.bridge)
        self.started: list[float] = []
        self.oversleep: dict[int, float] = {}
        self.notified: list[str] = []
        step = self.rig.balancer.step
        self.rig.balancer.step = lambda now: (self.started.append(now), step(now))
        monkeypatch.setattr(loop_module, "clock", SimpleNamespace(now=lambda: self.rig.now))
        monkeypatch.setattr(loop_module, "time", SimpleNamespace(sleep=self._sleep))
        monkeypatch.setattr(loop_module, "notify", lambda text, timeout_s: self.notified.append(text))

    def _sleep(self, seconds: float) -> None:
        self.rig.now += seconds + self.oversleep.get(len(self.started), 0.0)
        if len(self.started) >= self.end:
            self.loop.stop()

    def run(self, ticks: int) -> "VirtualLoop":
        self.end = len(self.started) + ticks - 1
        self.loop._stopping = False
        self.loop.run()
        return self
