"""Lockstep cores joined in memory under a virtual clock: what the lockstep tests play on.

A frame goes app -> bus -> mesh -> link -> mesh -> bus -> app. Either bus may lose it, and late copies may turn up from
anywhere. Robots keep their last `Save` on a disk that survives the process.
"""

import struct
from collections import Counter, deque

import links_world
from links_world import LinksWorld, way_around

from swarm.core.lockstep.actions import Advanced, Compute, Fault, Finished, Save, Send, Waiting
from swarm.core.lockstep.frames import Channel
from swarm.core.lockstep.lockstep import Lockstep

RUN = 0xA1
SCHEMA = 0x9F3C21AA
STATE = struct.Struct("<d")

EDGES = {
    "line": lambda n: [(i, i + 1) for i in range(n - 1)],
    "loop": lambda n: [(i, (i + 1) % n) for i in range(n)],
    "full": lambda n: [(i, j) for i in range(n) for j in range(i + 1, n)],
}


def named(edges):
    return [(f"r{i}", f"r{j}") for i, j in edges]


def first(name):
    """Packed x(0) and private state of a robot."""
    number = int(name[1:])
    return STATE.pack(number * 1.1 + 0.1), STATE.pack(1 / (number + 3))


def step(own, private, values):
    """An app whose result shows any change of order, value or private state in its last bits."""
    (x,), (memory,) = STATE.unpack(own), STATE.unpack(private)
    total = 0.0
    for i, value in enumerate(values):
        total += (0.1 + 0.07 * i) * (STATE.unpack(value)[0] - x)
    return STATE.pack(x + total / 3 + 0.01 * memory), STATE.pack(0.7 * memory + 0.3 * x)


def undisturbed(neighbours, last):
    """The synchronous run that nothing disturbs: value by robot and iteration."""
    now = {name: first(name) for name in neighbours}
    run = {name: [now[name][0]] for name in neighbours}
    for _ in range(last):
        now = {name: step(*now[name], [now[other][0] for other in sorted(neighbours[name])]) for name in neighbours}
        for name, (x, _) in now.items():
            run[name].append(x)
    return run


class Process(links_world.Process):
    """One process of the app on one robot, as the host would run it."""

    def __init__(self, world, robot, incarnation):
        super().__init__(world, robot)
        self.incarnation = incarnation
        self.channel = Channel(RUN, 0, incarnation, SCHEMA)
        self.core = Lockstep(
            *(robot, world.neighbours[robot], self.channel, STATE.size),
            last=world.last,
            rtt=world.rtt,
            linger=world.linger,
        )
        self.stopped = False
        self.inbox = deque(maxlen=64)  # of a bounded queue the oldest go first
        self.answers = []
        self.then = lambda: None
        """What follows when it dies after so many actions."""
        self.faults, self.waits, self.finished = [], [], None
        saved = world.disk.get(robot)
        if saved is None:
            x0, self.private = first(robot)
            self.core.start(x0, world.now, self.private)
        else:
            self.private = self.core.resume(saved, world.now)
        self.began_at = self.core.k

    def pump(self):
        super().pump()
        if not self.alive:
            then, self.then = self.then, lambda: None
            then()
        elif self.core.done and self.world.leave_when_done:
            self.die()

    def next_deadline(self):
        return None if self.stopped else self.core.next_deadline()

    def do(self, action):
        world = self.world
        match action:
            case Save(snapshot):
                world.disk[self.robot] = snapshot.encode()
            case Send(data, to, around):
                world.send(self, data, to, around=around)
            case Advanced(k, value):
                assert value == world.truth[self.robot][k], f"{self.robot} forked at iteration {k}"
                world.reached[self.robot] = max(world.reached[self.robot], k)
            case Compute(k, own, values):
                assert own == world.truth[self.robot][k]
                assert list(values) == sorted(world.neighbours[self.robot])
                result = step(own, self.private, values.values())
                if (delay := world.compute_time()) == 0:
                    self.answer(*result)
                else:
                    world.at(world.now + delay, lambda: self.answer(*result))
            case Fault(reason):
                self.faults.append(reason)
                world.on_fault(self, reason)
            case Waiting(k, peers):
                self.waits.append((world.now, k, peers))
            case Finished(k):
                assert k == world.last
                self.finished = world.now

    def answer(self, x_next, private):
        if not self.alive:
            return
        if self.stopped:
            self.answers.append((x_next, private))
            return
        if self.core.fault is None:
            self.private = private
        self.core.computed(x_next, private, self.world.now)
        self.pump()

    def receive(self, sender, text, data, *, around=False):
        if not self.alive:
            return
        if self.stopped:
            self.inbox.append(lambda: self.receive(sender, text, data, around=around))
            return
        self.core.receive(sender, Channel.parse(text), data, self.world.now, around=around)
        self.pump()

    def nudge(self):
        if self.alive and not self.stopped:
            self.core.nudge(self.world.now)

    def go_on(self):
        self.stopped = False
        for answer in self.answers:
            self.answer(*answer)
        self.answers.clear()
        while self.inbox:
            self.inbox.popleft()()

    def die(self):
        if self.alive:
            self.alive = False
            self.world.processes[self.robot].remove(self)


class World(LinksWorld):
    def __init__(self, edges, last, *, seed=0, latency=0.03, jitter=0.0, rtt=0.06, linger=1e9):
        super().__init__(edges, seed=seed, latency=latency, jitter=jitter)
        names = self.names
        self.neighbours = {name: {b if a == name else a for a, b in self.edges if name in (a, b)} for name in names}
        self.last, self.rtt, self.linger = last, rtt, linger
        self.truth = undisturbed(self.neighbours, last)
        self.compute = 0.0
        self.leave_when_done = False
        self.hears_itself = True
        self.disk = {}
        self.incarnations = Counter()
        self.processes = {name: [] for name in names}
        self.reached = dict.fromkeys(names, -1)
        self.sent = Counter()
        """Messages by (from, to, kind)."""
        self.around = 0
        """How many of them went around a link."""

    # Events

    def compute_time(self):
        return self.random.choice((0.0, 0.5, 1.0)) * self.compute

    # Processes

    def start(self, robot):
        """Start the app of a robot, from its disk if there is a snapshot; returns the process."""
        process = Process(self, robot, self.incarnations[robot])
        self.incarnations[robot] += 1
        self.processes[robot].append(process)
        process.pump()
        return process

    def start_all(self):
        for robot in self.processes:
            self.start(robot)

    def kill(self, robot):
        for process in list(self.processes[robot]):
            process.die()

    def one(self, robot):
        return self.processes[robot][-1]

    def running(self):
        return [process for processes in self.processes.values() for process in processes]

    @property
    def faults(self):
        return [reason for process in self.running() for reason in process.faults]

    def on_fault(self, process, reason):
        raise AssertionError(f"{process.robot}: {reason}")

    def finished(self):
        return all(k == self.last for k in self.reached.values())

    # Network

    def send(self, process, data, to, *, around=False):
        robot, text = process.robot, process.channel.text
        kind = data[0]
        if self.hears_itself:
            for other in list(self.processes[robot]):
                if other is not process and not self.lost():
                    self.at(self.now, lambda other=other: other.receive(robot, text, data))
        own_bus_lost = self.lost()
        for peer in sorted(self.neighbours[robot]) if to is None else [to]:
            assert peer in self.neighbours[robot]
            self.sent[robot, peer, kind] += 1
            if own_bus_lost:
                continue
            if around:
                self.around += 1
                if (way := way_around(self.edges, robot, peer)) is not None:
                    self.pass_on(way, lambda peer=peer: self.arrive(robot, peer, text, data, around=True))
                continue
            self.carry(robot, peer, lambda peer=peer: self.arrive(robot, peer, text, data))

    def arrive(self, sender, receiver, text, data, *, around=False):
        for process in list(self.processes[receiver]):
            if not self.lost():
                process.receive(sender, text, data, around=around)

    def cut_link(self, edge):
        self.cut.add(edge)

    def mend_link(self, edge):
        """A new connection; the link-up message goes over the bus too and may be lost (hole 8)."""
        self.cut.discard(edge)
        self.connection[edge] += 1
        for robot in edge:
            for process in self.processes[robot]:
                if not self.lost():
                    process.nudge()

    def heal(self):
        self.loss = self.copies = 0.0
        for edge in sorted(self.cut):
            self.mend_link(edge)
        for process in self.running():
            process.dies_after = None
            process.go_on()
        for robot in self.processes:
            if not self.processes[robot]:
                self.start(robot)

    # Checks

    def check_bounds(self):
        """Memory is bounded: three values a neighbour, one answer remembered."""
        for process in self.running():
            core = process.core
            for heard in core._peers.values():
                assert len(heard.slots) == 3
            assert set(core._answered) <= self.neighbours[process.robot]
            assert not core._actions
            if not core.fault and core.k < core._last:
                assert core._computing or core.waiting_for
