"""Locksteps joined in memory under a virtual clock: what the tests of epochs and of stop rules play on.

Robots keep pages (snapshots) in a directory that a reboot empties, and their vote where it does not. Every state that
a robot reaches is compared with a model: each epoch a plain synchronous run from the states its members entered with.
"""

import struct
from collections import Counter

import links_world
from links_world import LinksWorld, way_around

from services.apps.core.lockstep_run import LockstepRun, Renew
from services.apps.core.terms import Terms, Told
from swarm.core.epochs.actions import SaveEpochs, SendToNeighbours, SwitchEpoch
from swarm.core.epochs.notes import LOST, first
from swarm.core.graph import Graph
from swarm.core.lockstep.actions import Advanced, Compute, Fault, Finished, Save, Send, Waiting
from swarm.core.lockstep.frames import Channel

RUN, SCHEMA = 0xA1, 0x9F3C21AA
STATE = struct.Struct("<d")


def first_state(robot):
    number = int(robot[1:])
    return STATE.pack(number * 1.1 + 0.1), STATE.pack(1 / (number + 3))


def step(graph, robot, own, private, values):
    """A step whose last bits show any change of order, members, degrees or private state."""
    (x,), (memory,) = STATE.unpack(own), STATE.unpack(private)
    total = 0.0
    for weight, value in zip(graph.metropolis_weights(robot).values(), values, strict=True):
        total += weight * (STATE.unpack(value)[0] - x)
    return STATE.pack(x + total + 0.001 * memory), STATE.pack(0.7 * memory + 0.3 * x)


class Model:
    """The app of one robot."""

    size = STATE.size

    def __init__(self, robot, graph, content=lambda x: False):
        self.robot, self.graph = robot, graph
        self.k, self.own, self.private = 0, b"", b""
        self._content = content

    def start(self, measurement):
        return first_state(self.robot)

    def step(self, k, own, values, measurement):
        assert list(values) == sorted(self.graph.neighbours(self.robot))
        self.own, self.private = step(self.graph, self.robot, own, self.private, values.values())
        return self.own, self.private

    def restore(self, k, own, private, graph):
        self.own, self.private, self.graph = own, private, graph

    def renew(self, k, at, own, private, graph):
        self.restore(k, own, private, graph)
        return own, private

    def entered(self, k):
        """It takes no inputs."""

    def told(self):
        return Told({}, {})

    def content(self):
        return self._content(STATE.unpack(self.own)[0])


class Process(links_world.Process):
    """One process of the app on one robot."""

    def __init__(self, world, robot):
        super().__init__(world, robot)
        world.births[robot] += 1
        begin = first(tuple(world.names), world.edges, 0)
        self.program = Model(robot, begin.graph, world.content)
        self.program.own, self.program.private = first_state(robot)
        names, kept = frozenset(world.names), world.kept.get(robot)
        births = world.births[robot]
        lost = world.random.randrange(1, LOST) if robot in world.damaged else 0
        self.core = self.lockstep = LockstepRun(
            robot, names, world.terms, begin, begin.graph, births, self.program, kept, lost
        )
        self.lockstep.epochs.take_links(world.in_force)
        self.deadline = None
        self.renewed = []
        """The numbers of the epochs that it has gone over to."""
        self.finished = None
        self.computing = False
        saved = self.lockstep.saved(list(world.pages[robot].values()))
        answer = self.lockstep.start(saved, None)
        if world.starting:
            begins = world.now + world.starting
            world.at(begins, lambda: self.take(lambda _: self.lockstep.begin(saved, answer, world.now)))
        else:
            self.lockstep.begin(saved, answer, world.now)
        self.pump()

    def pump(self):
        super().pump()
        self.deadline = self.lockstep.next_deadline(self.world.now)

    def next_deadline(self):
        return self.deadline

    def do(self, action):
        world, robot, lockstep = self.world, self.robot, self.lockstep
        match action:
            case Save(snapshot):
                pages = world.pages[robot]
                k = max(pages, default=-1) + 1
                pages[k] = snapshot.encode()
                pages.pop(k - len(world.names) - 1, None)
                world.enters(robot, lockstep.channel.epoch, lockstep._history[-1])
            case SaveEpochs(kept):
                world.kept[robot] = kept
                world.damaged.discard(robot)
            case SendToNeighbours(data):
                world.broadcast(robot, lambda other: other.lockstep.receive_note(robot, data, world.now))
            case Send(data, to, around):
                channel = Channel.parse(lockstep.channel.text)

                def deliver(other):
                    other.lockstep.receive(robot, channel, data, world.now, around=around)

                if not around:
                    world.broadcast(robot, deliver, to)
                elif world.goes_around and (way := way_around(world.in_force, robot, to)) is not None:
                    world.pass_on(way, lambda: world.arrive(to, deliver))
            case Advanced(k, _):
                state = lockstep._history[-1]
                assert state.k == k
                world.reached(robot, lockstep.channel.epoch, k, (state.own[: STATE.size], state.private))
            case Compute():
                world.later(self, lambda: self._compute(action))
            case Renew(epoch):
                world.later(self, lambda: self._renew(epoch))
            case SwitchEpoch(epoch):
                world.decided(epoch)
            case Finished(k):
                self.finished = k
            case Fault(reason):
                world.on_fault(self, reason)
            case Waiting():
                pass
            case _:
                raise AssertionError(action)

    def _compute(self, todo):
        answer = self.lockstep.compute(todo, None)
        self.lockstep.computed(todo, answer, self.world.now)

    def _renew(self, epoch):
        assert epoch.number not in self.renewed, f"{self.robot} goes over to epoch {epoch.counter} twice"
        self.renewed.append(epoch.number)
        self.lockstep.renewed(epoch, self.lockstep.renew(epoch, None), self.world.now)

    def take(self, action):
        if self.alive:
            action(self)
            self.pump()

    def die(self):
        self.alive = False
        if self.world.processes.get(self.robot) is self:
            del self.world.processes[self.robot]


class World(LinksWorld):
    def __init__(self, edges, *, seed=0, last=None, rule=None, drop=True, after=2.0, content=lambda x: False):
        super().__init__(edges, seed=seed, latency=0.03, jitter=0.009)
        self.in_force = self.edges
        self.terms = Terms(RUN, SCHEMA, last, rule, drop, after)
        self.content = content
        self.compute = 0.01
        self.starting = 0.0
        """Seconds that the app's code takes before a process begins."""
        self.goes_around = True
        """Whether the mesh finds ways around links that are cut."""
        self.births = Counter()
        self.pages = {name: {} for name in self.names}
        self.kept = {}
        self.processes = {}
        self.epochs = {0: first(tuple(self.names), self.edges, 0)}
        self.successors = {}
        self.entered = {}
        self.truth = {}
        self.progress = dict.fromkeys(self.names, (0, -1))
        self.rebooted = set()
        self.damaged = set()
        """Robots whose file of votes is damaged."""

    # Events

    def later(self, process, action):
        """What the app does takes a while, and one thing goes after the other."""
        begin = max(self.now, getattr(process, "free_at", 0.0))
        process.free_at = begin + self.compute * self.random.choice((0.0, 0.5, 1.0))
        self.at(process.free_at, lambda: process.take(lambda _: action()))

    def running(self):
        return self.processes.values()

    # Processes

    def start(self, robot):
        if robot not in self.processes:
            self.processes[robot] = None
            process = Process.__new__(Process)
            self.processes[robot] = process
            process.__init__(self, robot)

    def start_all(self):
        for name in self.names:
            self.start(name)

    def kill(self, robot):
        if robot in self.processes:
            self.processes[robot].die()

    def reboot(self, robot):
        self.kill(robot)
        self.pages[robot].clear()
        self.rebooted.add(robot)

    def damage(self, robot):
        """The file with a robot's votes is damaged while its process is away."""
        self.kill(robot)
        if self.kept.pop(robot, None) is not None:
            self.damaged.add(robot)

    # Network

    def broadcast(self, robot, deliver, to=None):
        if self.lost():
            return
        for edge in sorted(self.edges):
            if robot in edge:
                other = edge[1] if edge[0] == robot else edge[0]
                if to in (None, other):
                    self.carry(robot, other, lambda other=other: self.arrive(other, deliver))

    def arrive(self, other, deliver):
        if other in self.processes and not self.lost():
            self.processes[other].take(deliver)

    def heal(self):
        self.loss = 0.0
        self.cut.clear()
        for process in self.processes.values():
            process.dies_after = None
        for name in self.names:
            self.start(name)

    # What must hold

    def on_fault(self, process, reason):
        raise AssertionError(f"{process.robot}: {reason}")

    def decided(self, epoch):
        """One successor to each epoch, whoever has found it out, unless the operator has forced one."""
        self.epochs[epoch.number] = epoch
        if not epoch.forced:
            known = self.successors.setdefault(epoch.before, epoch)
            assert known == epoch, f"two epochs after {epoch.before}: {known} and {epoch}"

    def enters(self, robot, number, state):
        """What is written is what counts: it may be sent before the process dies, and told by nobody else."""
        if state.k == self.epochs[number].k:
            self.entered.setdefault((number, robot), (state.own[: STATE.size], state.private))

    def reached(self, robot, number, k, state):
        epoch = self.epochs[number]
        assert robot in epoch.members
        if k == epoch.k:
            assert self.entered[number, robot] == state
            if state == first_state(robot) and robot in self.rebooted:
                pass  # whatever it had promised to go on from is gone
            elif robot in epoch.carried:
                assert state == self.model(epoch.before, robot, k), f"{robot} did not go on from x({k})"
            elif number == 0:
                assert state == first_state(robot)
        assert state == self.model(number, robot, k), f"{robot} forked at iteration {k} of epoch {epoch.counter}"
        self.progress[robot] = (epoch.counter, k)

    def model(self, number, robot, k):
        """The state of a robot at iteration k of an epoch, were it a plain synchronous run from its start."""
        epoch = self.epochs[number]
        if k == number == 0:  # a robot that still starts may have told of it, and never enter the first epoch
            return first_state(robot)
        if k == epoch.k:
            return self.entered[number, robot]
        if (number, robot, k) not in self.truth:
            graph = epoch.graph
            for at in range(epoch.k + 1, k + 1):  # from the front: not as deep as the run is long
                for name in sorted(graph.distances(robot), key=lambda n: n != robot):
                    if (number, name, at) in self.truth or self._far(graph, robot, name) > k - at:
                        continue
                    own, private = self.model(number, name, at - 1)
                    near = [self.model(number, other, at - 1)[0] for other in graph.neighbours(name)]
                    self.truth[number, name, at] = step(graph, name, own, private, near)
        return self.truth[number, robot, k]

    @staticmethod
    def _far(graph, a, b):
        return graph.distances(a)[b]

    def together(self):
        """Whether all robots are in one epoch, the newest that any of them knows, with all robots in it."""
        known = [process.lockstep.epochs.epoch for process in self.processes.values()]
        newest = max(known, key=lambda epoch: (epoch.counter, epoch.number), default=self.epochs[0])
        return newest.members == tuple(self.names) and all(
            name in self.processes
            and self.processes[name].lockstep.channel.epoch == newest.number
            and self.processes[name].lockstep.begun
            for name in self.names
        )

    def moving(self, rounds=5):
        """Whether all robots get on, within some seconds."""
        return self.moving_of(*self.names, rounds=rounds)

    def moving_of(self, *names, rounds=5):
        """Whether these robots get on, within some seconds."""
        before = {name: self.processes[name].lockstep.k for name in names}
        return self.run(10.0, until=lambda: all(self.processes[n].lockstep.k >= before[n] + rounds for n in names))


def line(n):
    return [(f"r{i}", f"r{i + 1}") for i in range(n - 1)]


def loop(n):
    return [*line(n), ("r0", f"r{n - 1}")]


def full(n):
    return Graph.of_shape("full", [f"r{i}" for i in range(n)]).edges
