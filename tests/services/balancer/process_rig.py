"""The balancer's real processes, started for a test, and who listens to what they say."""

import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Processes, wait_until

from services.balancer.core.faults import FELL
from swarm.bus.zenoh_bus import Bus
from swarm.messages import BalancerState, SetMode, read

FALLS_AFTER = 10
"""Ticks without which a body falls, at least."""


class Watcher:
    """Everything the robot says, by topic."""

    def __init__(self, runtime: Path) -> None:
        self.heard: dict[str, list] = defaultdict(list)
        self.bus = Bus.of(runtime)
        self.bus.subscribe("swarm/r0/balancer/*", self._take)

    def _take(self, key: str, payload: bytes) -> None:
        self.heard[key.rpartition("/")[2]].append(read(key, payload))

    def last(self, topic: str = "state") -> BalancerState:
        return self.heard[topic][-1] if self.heard[topic] else None

    def lamps(self) -> tuple[bool, bool, bool] | None:
        leds = self.last("leds")
        return None if leds is None else (leds.red, leds.yellow, leds.green)

    def wait_mode(self, mode: str) -> BalancerState:
        wait_until(lambda: self.last() is not None and self.last().mode == mode, what=f"mode {mode}")
        return self.last()

    def wait_balancing(self) -> BalancerState:
        """Wait until it balances. Where it has fallen it is told to stand up again: its body falls in real time, and a
        busy host keeps its loop from computing."""
        told = -math.inf

        def balances() -> bool:
            nonlocal told
            state = self.last()
            if state is not None and state.mode == "fault" and state.t > told + 1.0:
                told = state.t
                self.command("mode", SetMode("stand"))
            return state is not None and state.mode == "balancing"

        wait_until(balances, what="mode balancing")
        return self.last()

    def assert_balancing(self) -> None:
        """Assert that it balances. A body falls where the host keeps its loop from computing, which is no fault of the
        balancer: the loop has then missed ticks since it balanced last."""
        state = self.last()
        balanced = next(each for each in reversed(self.heard["state"]) if each.mode == "balancing")
        assert state.mode == "balancing" or (FELL in state.fault and state.missed >= balanced.missed + FALLS_AFTER)

    @staticmethod
    def body_pid(processes: Processes) -> int:
        return processes._started[-1].pid

    def command(self, what: str, message: object) -> None:
        self.bus.publish(f"swarm/r0/balancer/set/{what}", message)


@pytest.fixture
def watcher(runtime: Path, router: object) -> Iterator[Watcher]:
    watcher = Watcher(runtime)
    yield watcher
    watcher.bus.close()
