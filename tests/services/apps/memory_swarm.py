"""A swarm of app runners and lockstep cores joined in memory: no process, no clock, no thread."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from services.apps import loader
from services.apps.runner import Runner
from swarm.config import Anchor, AppConfig, Config
from swarm.config.types import RobotConfig
from swarm.core.graph import Graph
from swarm.core.lockstep.actions import Advanced, Compute, Fault, Finished, Save, Send
from swarm.core.lockstep.frames import Channel
from swarm.core.lockstep.lockstep import Lockstep
from swarm.messages import Measurement

MeasurementOf = Callable[[str, int], Measurement]

THESIS_X0 = {3: (0.5, 3.0, 5.0), 6: (0.5, 1.0, 2.0, 3.0, 4.0, 5.0)}
TARGET = (0.5, 1.0)
PLACES = ((0.5, 1.5), (1.0, 0.5), (1.5, 1.5), (1.5, 0.5), (0.35, 0.4), (1.0, 1.75))
ANCHORS = (Anchor("D001", 0.0, 0.0), Anchor("D002", 1.94, 0.0), Anchor("D003", 1.0, 1.94))


def config_of(
    count: int,
    shape: str = "line",
    app: str = "consensus",
    parameters: Mapping[str, Any] | None = None,
    robots: Mapping[str, Mapping[str, Any]] | None = None,
    anchors: Sequence[Anchor] = ANCHORS,
) -> Config:
    names = [f"r{i}" for i in range(count)]
    return Config(
        path=Path("swarm.toml"),
        network="test",
        robots=tuple(RobotConfig(name) for name in names),
        edges=Graph.of_shape(shape, names).edges,
        relay=(),
        anchors=tuple(anchors),
        apps={app: AppConfig(dict(parameters or {}), dict(robots or {}))},
    )


class MemorySwarm:
    """Runs an app on all robots; `trajectory[name][k]` is the packed state, `results[name][k]` what it reports.

    A result may take longer than a step: who wants only `final` says `every=False`, and `results` are those alone.
    """

    def __init__(
        self, app: str, config: Config, last: int, measure: MeasurementOf | None = None, *, every: bool = True
    ) -> None:
        found = loader.load(app)
        found.check(config)
        self.runners = {n: Runner(found.make(config, n, seed=1), found.source) for n in config.names}
        self.trajectory: dict[str, list[bytes]] = {n: [] for n in config.names}
        self.results: dict[str, list[dict[str, Any]]] = {n: [] for n in config.names}
        self.messages = 0
        self._config = config
        self._measure = measure
        self._last, self._every = last, every
        self._cores: dict[str, Lockstep] = {}
        self._queue: list[tuple[str, str, bytes]] = []
        for name, runner in self.runners.items():
            channel = Channel(1, 0, 1, runner.schema.hash)
            self._cores[name] = Lockstep(name, config.neighbours(name), channel, runner.schema.size, last=last)
        for name, core in self._cores.items():
            own, private = self.runners[name].start(self._measurement(name, 0))
            core.start(own, 0.0, private)
            self._carry_out(name)
        while self._queue:
            sender, receiver, data = self._queue.pop(0)
            self._cores[receiver].receive(sender, self._cores[sender].channel, data, 0.0)
            self._carry_out(receiver)
        assert all(core.done for core in self._cores.values())

    @cached_property
    def states(self) -> dict[str, list[dict[str, Any]]]:
        """`trajectory` by the fields' names."""
        return {
            name: [schema.message_values(dict(zip(schema.names, schema.unpack(each), strict=True))) for each in packed]
            for name, packed in self.trajectory.items()
            for schema in (self.runners[name].schema,)
        }

    @property
    def final(self) -> dict[str, dict[str, Any]]:
        return {name: results[-1] for name, results in self.results.items()}

    def _measurement(self, name: str, k: int) -> Measurement | None:
        return None if self._measure is None else self._measure(name, k)

    def _carry_out(self, name: str) -> None:
        core, runner = self._cores[name], self.runners[name]
        while actions := core.actions():
            for action in actions:
                match action:
                    case Save():
                        pass  # nobody restarts here
                    case Send(data, to, False):
                        receivers = self._config.neighbours(name) if to is None else (to,)
                        self.messages += len(receivers)
                        self._queue += [(name, receiver, data) for receiver in receivers]
                    case Advanced(k, value):
                        assert k == len(self.trajectory[name]) == runner.k
                        self.trajectory[name].append(value)
                        if self._every or k == self._last:
                            self.results[name].append(runner.result())
                    case Compute(k, own, values):
                        core.computed(*runner.step(k, own, values, self._measurement(name, k)), 0.0)
                    case Fault(reason):
                        raise AssertionError(reason)
                    case Finished(k):
                        assert k == len(self.trajectory[name]) - 1
                    case _:
                        raise AssertionError(action)
