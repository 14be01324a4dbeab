"""Overlays between real mesh and bus processes over simulated links, beside what the links' latency allows."""

import contextlib
import json
import queue
import signal
import statistics
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from bench.rigs.running import robots_folder
from bench.rows import Row, possible
from services.mesh.links.sim import AIR_SOCKET
from sim.control import link_cuts
from sim.processes.processes import Child, Processes
from swarm import clock
from swarm.app.overlays import Overlays
from swarm.bus.zenoh_bus import Bus
from swarm.errors import SwarmError
from swarm.messages import Members, Status
from swarm.messages.codec import decode

LATENCY_S = 0.03
"""One way, as the thesis' radio at small payloads."""

GOAL = 1.15
ALL_KNOW_GOAL = 1.1
AT_ONCE = 16
CLOSED_LIMIT_S = 0.3
SILENT_LIMIT_S = 3.5
PERIOD_S = 0.02
"""s between two messages while a link is lost."""

WAIT_S = 30.0

T = TypeVar("T")


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    repeats: int = 40
    floods: int = 1000
    """Floods in a row that must all be complete, most of them several at a time."""

    losses: int = 5
    """Links lost in each way, at any time of their heartbeats."""


FULL = Sizes()
SMOKE = Sizes(3, 16, 1)


class Swarm:
    """Buses and meshes of real robots in a directory of their own. A context."""

    def __init__(
        self, edges: Sequence[tuple[int, int]], air: str = f"latency={LATENCY_S}", *, wait: bool = True
    ) -> None:
        """`air` as of SWARM_SIM_LINK; with `wait` the context begins when every robot sees all others."""
        self._wait = wait
        self._stack = contextlib.ExitStack()
        self._home = Path(self._stack.enter_context(robots_folder()))
        count = 1 + max(max(edge) for edge in edges)
        self.names = [f"r{number}" for number in range(count)]
        robots = "".join(
            f'[[robots]]\nname = "{name}"\nlink = "sim:{self._home}/{name}/mesh.sock"\n' for name in self.names
        )
        pairs = [[f"r{a}", f"r{b}"] for a, b in edges]
        config = self._home / "swarm.toml"
        config.write_text(
            f'network = "bench"\n[topology]\nedges = {json.dumps(pairs)}\n[mesh]\ninsecure = true\n{robots}'
        )
        self._processes = Processes({"SWARM_CONFIG": str(config), "SWARM_SIM_LINK": air})
        self._stack.callback(self._processes.stop)
        for name in self.names:
            (self._home / name).mkdir()
            for service in ("bus", "mesh"):
                self._processes.add(name, service, [f"services.{service}"], self._home / name)
        self.buses = {name: Bus.of(self._home / name) for name in self.names}
        for bus in self.buses.values():
            self._stack.callback(bus.close)
        self.overlays = {name: Overlays(bus, name, "bench") for name, bus in self.buses.items()}

    def __enter__(self) -> "Swarm":
        if self._wait:
            self.wait_for(lambda: all(self._sees_all(name) for name in self.names), "every robot sees all others")
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def runs(self) -> bool:
        """Whether every mesh has opened its end of the simulated radio."""
        return all((self._home / name / AIR_SOCKET).exists() for name in self.names)

    def mesh(self, name: str) -> Child:
        """The mesh process of a robot."""
        return next(child for child in self._processes.of(name) if child.service == "mesh")

    def kill(self, name: str) -> None:
        """End a robot's mesh without a word; its neighbours see their sockets close."""
        process = self.mesh(name).process
        assert process is not None
        process.send_signal(signal.SIGKILL)
        process.wait()

    def cut(self, a: str, b: str, seconds: float) -> None:
        """Silence a link; both ends must notice it themselves."""
        for name, peer in ((a, b), (b, a)):
            link_cuts.silence(self._home, name, peer, seconds)

    def counters(self) -> dict[str, int]:
        """Counters of all meshes, added up."""
        total: dict[str, int] = {}
        for name in self.names:
            for counter, value in self._ask(name, "status", Status).counters.items():
                total[counter] = total.get(counter, 0) + value
        return total

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until something is so."""
        deadline = clock.now() + WAIT_S
        while not condition():
            if clock.now() > deadline:
                raise SwarmError(f"not within {WAIT_S:g} s: {what}")
            threading.Event().wait(0.05)

    def _sees_all(self, name: str) -> bool:
        return all(member.state == "here" for member in self._ask(name, "members", Members).members)

    def _ask(self, name: str, topic: str, kind: type[T]) -> T:
        answers: queue.SimpleQueue[T] = queue.SimpleQueue()
        while True:
            self.buses[name].ask(
                f"swarm/{name}/mesh/{topic}",
                lambda key, payload: answers.put(decode(kind, payload, key)),
                timeout_s=1.0,
            )
            with contextlib.suppress(queue.Empty):
                return answers.get(timeout=1.0)


def line(count: int) -> list[tuple[int, int]]:
    """r0 - r1 - ..."""
    return [(number, number + 1) for number in range(count - 1)]


def loop(count: int) -> list[tuple[int, int]]:
    """The same, closed."""
    return [*line(count), (count - 1, 0)]


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    with Swarm(line(6)) as swarm:
        yield from _floods(swarm, sizes)
    with Swarm(line(4)) as swarm:
        yield from _messages(swarm, sizes.repeats)
    for how, limit, lose in (
        ("socket closed", CLOSED_LIMIT_S, lambda swarm: swarm.kill("r1")),
        ("silence", SILENT_LIMIT_S, lambda swarm: swarm.cut("r0", "r1", 10.0)),
    ):
        longest = max(_rerouted(lose) for _ in range(sizes.losses))
        yield Row(f"link lost ({how}) to re-routed unicast, longest of {sizes.losses}", longest, "s", limit, 1.0)


def _floods(swarm: Swarm, sizes: Sizes) -> Iterator[Row]:
    arrivals: queue.SimpleQueue[float] = queue.SimpleQueue()
    swarm.overlays["r5"].on_flood(lambda origin, payload: arrivals.put(clock.now()))
    swarm.overlays["r0"].flood(b"warm up").result(WAIT_S)
    arrivals.get(timeout=WAIT_S)
    before = swarm.counters().get("wave_sent", 0)
    reach, confirmed = [], []
    for _ in range(sizes.repeats):
        began = clock.now()
        handle = swarm.overlays["r0"].flood(b"hello", priority="sync")
        handle.result(WAIT_S)
        confirmed.append(clock.now() - began)
        reach.append(arrivals.get(timeout=WAIT_S) - began)
    sent = swarm.counters().get("wave_sent", 0) - before
    yield Row("flood line 6 from one end, reach", statistics.median(reach), "s", 5 * LATENCY_S, GOAL)
    yield Row("flood line 6 from one end, confirmed", statistics.median(confirmed), "s", 10 * LATENCY_S, GOAL)
    both_ways = 2.0 * (len(swarm.names) - 1)
    count = possible(sent / sizes.repeats, both_ways)
    yield Row("messages of a confirmed flood, line 6 (2E)", count, "", both_ways, 1.0)
    yield from _all_know(swarm, sizes.repeats)
    complete, done = 0, 0
    while done < sizes.floods:
        handles = [swarm.overlays[name].flood(b"x") for name in (swarm.names * AT_ONCE)[:AT_ONCE]]
        for handle in handles:
            answer = handle.result(WAIT_S)
            complete += answer.complete and len(answer.robots) == len(swarm.names) - 1
        done += AT_ONCE
    # Missing ones as a share: the goal is none at all.
    yield Row(f"floods not complete, of {done}", done - complete, "", 1.0, 0.0)


def _all_know(swarm: Swarm, repeats: int) -> Iterator[Row]:
    """From the request until the last robot has learned that all have a flood, whose messages are counted."""
    told: queue.SimpleQueue[float] = queue.SimpleQueue()
    for each in swarm.overlays.values():
        each.on_complete(lambda origin, answer: told.put(clock.now()))
    for name, origin, hops in (("one end", "r0", 10), ("robot 2", "r2", 8)):
        took = []
        before = swarm.counters().get("wave_sent", 0)
        for _ in range(repeats):
            began = clock.now()
            swarm.overlays[origin].flood(b"hello", priority="sync", announce=True).result(WAIT_S)
            known = clock.now()
            others = [told.get(timeout=WAIT_S) for _ in swarm.names[1:]]
            took.append(max(known, *others) - began)
        sent = (swarm.counters().get("wave_sent", 0) - before) / repeats
        yield Row(f"flood line 6 from {name}, all know", statistics.median(took), "s", hops * LATENCY_S, ALL_KNOW_GOAL)
        both_ways = 2.0 * (len(swarm.names) - 1)
        # Each link carries the flood away and what comes back of it, at least.
        count = possible(sent, both_ways)
        yield Row(f"messages until all know of a flood from {name} (4E)", count, "", 2 * both_ways, 1.0)


def _messages(swarm: Swarm, repeats: int) -> Iterator[Row]:
    arrivals: queue.SimpleQueue[float] = queue.SimpleQueue()
    swarm.overlays["r3"].on_message(lambda sender, payload: arrivals.put(clock.now()))
    swarm.overlays["r0"].send("r3", b"warm up").result(WAIT_S)
    arrivals.get(timeout=WAIT_S)
    arrived, confirmed = [], []
    for _ in range(repeats):
        began = clock.now()
        swarm.overlays["r0"].send("r3", b"hello", priority="sync").result(WAIT_S)
        confirmed.append(clock.now() - began)
        arrived.append(arrivals.get(timeout=WAIT_S) - began)
    yield Row("unicast 3 hops, one way", statistics.median(arrived), "s", 3 * LATENCY_S, GOAL)
    yield Row("unicast 3 hops, confirmed", statistics.median(confirmed), "s", 6 * LATENCY_S, GOAL)


def _rerouted(lose: Callable[[Swarm], None]) -> float:
    """Messages leave r0 for r2 all the time, by r1 in a loop of six. From the loss until all that were under way and
    the first one after it are there, the long way round, s."""
    with Swarm(loop(6)) as swarm:
        return _from_loss(swarm, lambda: lose(swarm))


def _from_loss(swarm: Swarm, lose: Callable[[], None]) -> float:
    arrivals: dict[bytes, float] = {}

    def arrived(sender: str, payload: bytes) -> None:
        arrivals.setdefault(payload, clock.now())

    swarm.overlays["r2"].on_message(arrived)
    swarm.overlays["r0"].send("r2", b"warm up").result(WAIT_S)
    stop = threading.Event()
    sent: list[tuple[float, bytes]] = []

    def chatter() -> None:
        while not stop.wait(PERIOD_S):
            payload = str(len(sent)).encode()
            sent.append((clock.now(), payload))
            swarm.overlays["r0"].send("r2", payload, priority="sync")

    thread = threading.Thread(target=chatter)
    thread.start()
    swarm.wait_for(lambda: len(arrivals) > 20, "messages arrive")
    lost_at = clock.now()
    lose()
    swarm.wait_for(
        lambda: any(at > lost_at and payload in arrivals for at, payload in sent), "a message after the loss"
    )
    stop.set()
    thread.join()
    first = next(at for at, payload in sent if at > lost_at)
    swarm.wait_for(lambda: all(payload in arrivals for at, payload in sent if at <= first), "those under way")
    last = max(arrivals[payload] for at, payload in sent if at <= first)
    return last - lost_at
