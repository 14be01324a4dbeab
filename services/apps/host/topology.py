"""The links of a run: the topology in force when it began, kept for as long as the run lasts.

Weights and neighbours follow from the links, so all robots of a run must have the same ones. A checksum of them is the
run's epoch, and with it part of the channel: hosts that began on different links never take each other's values. A host
that is started anew in mid-run goes on with the links that its run began with, whatever holds then.
"""

import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from services.apps.persistence import run_file
from swarm import clock
from swarm.app.run_options import RunOptions
from swarm.config import Config
from swarm.core.epochs.notes import Epoch, first
from swarm.core.graph import Edge, Graph
from swarm.core.lockstep.frames import Channel
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.messages import AppProgress, Topology
from swarm.messages.codec import decoded
from swarm.messages.keys import key
from swarm.process.runtime import refuse
from swarm.process.service import Service

CONFIGURED = 0
"""The epoch of the configuration's links."""

ASK_EVERY = 0.2
"""Seconds between two questions to the mesh."""

TELL_EVERY = 1.0
"""Seconds between two messages that there is no answer that could be used."""

SETTLED = 5.0
"""Seconds for which an automatic topology must have stayed the same: hosts that start together then have the same
one."""


class RunPlace(NamedTuple):
    """The place of an app: its robot, swarm and run. Thousands of robots in one process may share the same objects."""

    run: int
    """The run's number, the same on all robots."""
    digest: bytes
    """A digest of the app's source."""
    options: RunOptions
    """How long the app runs, and what becomes of robots that are away."""
    names: frozenset[str]
    """All robots of the configuration."""
    begin: Epoch
    """The members and links with which the run began."""
    graph: Graph
    """The graph of those links."""
    incarnation: int
    """A number that goes up with every start of the app's process or of the robot."""

    @classmethod
    def of(
        cls, run: int, digest: bytes, options: RunOptions, config: Config, epoch: int, incarnation: int
    ) -> "RunPlace":
        """Return the place in a run that begins with the links of a configuration; `epoch` is the number of these
        links."""
        begin = first(config.names, config.edges, epoch)
        return cls(run, digest, options, frozenset(config.names), begin, config.graph, incarnation)


class RunLinks(NamedTuple):
    """The links between the robots of a run."""

    config: Config
    """The configuration with these links in the place of its own."""
    epoch: int
    kept: bool
    """Whether they are those of an earlier process of the run."""


@frozen
class _Kept:
    run: int
    edges: tuple[Edge, ...]


def of_run(service: Service, app: str, run: int) -> RunLinks | None:
    """Return the links of a run; waits for the mesh where they are not known yet. None = told to stop."""
    config = service.config
    kept = run_file.read(_Kept, _path(service.runtime, app), run, "the links in force hold")
    if kept is not None:
        return of_edges(config, kept.edges, kept=True)
    if len(config.robots) == 1:
        return of_edges(config, ())
    answers: deque[Topology] = deque(maxlen=1)
    answered = threading.Event()

    def take(topology: Topology) -> None:
        answers.append(topology)
        answered.set()

    on_reply = decoded(Topology, take, partial(refuse, service))
    told_at = clock.now()
    while True:
        answered.clear()
        service.bus.ask(key(service.robot, "mesh", "topology"), on_reply, timeout_s=TELL_EVERY)
        answered.wait(ASK_EVERY)
        reason = lacking(config, answers[-1], clock.now()) if answers else "the mesh does not tell its topology"
        if not reason:
            return of_edges(config, answers[-1].edges)
        if clock.now() >= told_at + TELL_EVERY:
            told_at = clock.now()
            service.waits(reason)
            progress = AppProgress(told_at, "starting", 0, (), reason)
            service.bus.publish(key(service.robot, f"app/{app}", "progress"), progress)
        if service.stopping.wait(ASK_EVERY):
            return None


def lacking(config: Config, topology: Topology, now: float) -> str:
    """Return why a run cannot begin on a topology; empty where it can."""
    reached = Graph(config.names, topology.edges).distances(config.names[0])
    if len(reached) < len(config.names):
        missing = " ".join(name for name in config.names if name not in reached)
        return f"the automatic topology does not link all robots yet, not {missing}"
    if topology.auto and now < topology.since + SETTLED:
        return "the automatic topology has just changed"
    return ""


def save(runtime: Path, app: str, run: int, links: RunLinks) -> None:
    """Keep the links for the later processes of the run; `LocalError` where that cannot be."""
    path = _path(runtime, app)
    try:
        run_file.write(path, _Kept(run, links.config.edges))
    except OSError as error:
        raise LocalError(f"{path}: {error.strerror}") from None


class TopologyWatch:
    """A watch on the mesh's topology and on other hosts' epochs for a run that goes on."""

    def __init__(self, neighbours: Iterable[str], on_lost: Callable[[str], None]) -> None:
        """`neighbours` are those that the run needs; `on_lost(text)` is called when the topology in force takes a link
        with one away."""
        self._needed = frozenset(neighbours)
        self._on_lost = on_lost
        self._lost: frozenset[str] = frozenset()
        self._version = ""
        self._strangers: dict[str, str] = {}

    def take(self, topology: Topology) -> None:
        """Take the topology in force."""
        lost = self._needed - set(topology.wanted)
        self._version = topology.number
        if lost - self._lost:
            self._on_lost(self._text(lost))
        self._lost = lost

    def heard(self, sender: str, theirs: Channel, ours: Channel) -> None:
        """Take the identity of a frame under this app's name, and note a robot whose frames do not belong to this
        run."""
        if theirs.run != ours.run:
            reason = "is in another run: another number, other sources of the app, or another swarm.toml"
        elif theirs.schema != ours.schema:
            reason = "runs another version of this app"
        elif theirs.epoch != ours.epoch:
            reason = "began on other links: start a new run, with another number"
        else:
            self._strangers.pop(sender, None)
            return
        self._strangers[sender] = reason

    def need(self, neighbours: Iterable[str]) -> None:
        """The run needs links with other robots from now on."""
        self._needed = frozenset(neighbours)
        self._lost &= self._needed

    def forget(self) -> None:
        """Other members are in force: what was heard of other hosts says nothing any more."""
        self._strangers.clear()

    def reason(self, waiting: tuple[str, ...]) -> str:
        """Return why robots are waited for, where that is known; else empty."""
        by_reason: dict[str, list[str]] = {}
        for name in waiting:
            if name in self._strangers:
                by_reason.setdefault(self._strangers[name], []).append(name)
        if by_reason:
            return "; ".join(f"{' '.join(names)} {reason}" for reason, names in by_reason.items())
        lost = self._lost.intersection(waiting)
        return self._text(lost) if lost else ""

    def _text(self, lost: frozenset[str]) -> str:
        return (
            f"topology {self._version} has no link with {' '.join(sorted(lost))}, which this run needs: "
            "set one that has it, or start a new run"
        )


def _path(runtime: Path, app: str) -> Path:
    return runtime / f"app.{app}.topology"


def of_edges(config: Config, edges: tuple[Edge, ...], *, kept: bool = False) -> RunLinks:
    """Return the links of a run from the links in force."""
    pairs = Graph(config.names, edges).edges
    epoch = CONFIGURED if pairs == config.edges else zlib.crc32(repr(pairs).encode()) or 1
    return RunLinks(replace(config, edges=pairs), epoch, kept)
