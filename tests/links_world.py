"""Robots joined by links in memory under virtual time: what the worlds of locksteps and of epochs have in common.

A link keeps the order of what it carries, and a connection that ends takes what is in flight with it. A process may
die between any two of its core's actions.
"""

from collections import deque
from random import Random

import networkx
from timed_world import TimedWorld


def way_around(edges, sender, receiver):
    """The robots of a shortest way that does not use the link between the two, as a mesh finds it; None: there is none.

    A mesh does not know of cuts yet: `edges` are all links."""
    graph = networkx.Graph(edges)
    graph.remove_edges_from([(sender, receiver)])
    try:
        return networkx.shortest_path(graph, sender, receiver)
    except (networkx.NetworkXNoPath, networkx.NodeNotFound):
        return None


class Process:
    """One process of the app on one robot. A subclass makes `core`, and carries out one action of it in `do`."""

    core = None

    def __init__(self, world, robot):
        self.world, self.robot = world, robot
        self.alive = True
        self.dies_after = None
        """So many more actions until the process dies."""

    def pump(self):
        """Carry out the actions in order, and perhaps die between two of them."""
        todo = deque(self.core.actions())
        while todo and self.alive:
            if self.dies_after is not None:
                self.dies_after -= 1
                if self.dies_after < 0:
                    self.die()
                    return
            self.do(todo.popleft())
            todo += self.core.actions()

    def next_deadline(self):
        raise NotImplementedError

    def handle_timer(self):
        self.core.handle_timer(self.world.now)
        self.pump()
        later = self.next_deadline() if self.alive else None
        assert later is None or later > self.world.now, "a timer that fires for ever"


class LinksWorld(TimedWorld):
    def __init__(self, edges, *, seed, latency, jitter):
        super().__init__()
        self.edges = tuple(sorted(tuple(sorted(edge)) for edge in edges))
        self.names = sorted({name for edge in self.edges for name in edge})
        self.latency, self.jitter = latency, jitter
        self.random = Random(seed)
        self.loss = 0.0
        """Chance that a bus loses a message, on either side."""
        self.copies = 0.0
        """Chance that a message turns up once more, up to 3 s later."""
        self.cut = set()
        self.connection = dict.fromkeys(self.edges, 0)
        self._last_arrival = {}

    def running(self):
        """All processes."""
        raise NotImplementedError

    def timers(self):
        return [
            (deadline, process.handle_timer)
            for process in self.running()
            if (deadline := process.next_deadline()) is not None
        ]

    def lost(self):
        return self.loss > 0 and self.random.random() < self.loss

    def carry(self, sender, receiver, arrive):
        """Call `arrive` when a message has crossed a link, if it does."""
        edge = tuple(sorted((sender, receiver)))
        if edge in self.cut:
            return
        connection = self.connection.get(edge)
        arrival = self.now + self.latency + self.jitter * self.random.random()
        arrival = max(arrival, self._last_arrival.get((sender, receiver), 0.0))
        self._last_arrival[sender, receiver] = arrival

        def over():
            if edge not in self.cut and self.connection.get(edge) == connection:
                arrive()

        self.at(arrival, over)
        if self.copies > 0 and self.random.random() < self.copies:
            self.at(arrival + 3 * self.random.random(), arrive)

    def pass_on(self, way, arrive):
        """From robot to robot; over the last link `arrive` is called."""
        sender, receiver, *rest = way
        self.carry(sender, receiver, (lambda: self.pass_on((receiver, *rest), arrive)) if rest else arrive)
