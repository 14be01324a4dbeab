"""The swarm as `swarm mesh` has collected it: the links that count, and their round-trip times."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from swarm.core.graph import Graph, pair_of
from swarm.messages import Clock, GraphRobot, Links, LinkState, MeasuredHub, Topology
from swarm.onboard.buses.ask import AWAY

UP = ("up", "suspect")


@dataclass
class MeshView:
    """One robot's report of its own mesh."""

    links: Links | None = None
    clock: Clock | None = None
    counters: dict[str, int] | None = None
    topology: Topology | None = None

    @property
    def complete(self) -> bool:
        """Return whether no report is missing."""
        return None not in (self.links, self.clock, self.counters, self.topology)


@dataclass
class CollectedMesh:
    """The whole swarm, collected from the reports of its robots."""

    views: Mapping[str, MeshView]
    """The answers of the robots that were asked."""
    robots: Mapping[str, GraphRobot] = field(default_factory=dict)
    """All robots, each by the best report of it."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of all robots that any report mentions."""
        return tuple(sorted({*self.views, *self.robots, *(link.peer for _, link in self.links())}))

    def links(self) -> Iterator[tuple[str, LinkState]]:
        """Yield the links of the robots that were asked, each with its robot."""
        for name, view in self.views.items():
            if view.links is not None:
                for link in view.links.links:
                    yield name, link

    @cached_property
    def topology(self) -> Topology | None:
        """Return the newest topology that is known, None where no robot has told one."""
        told = [view.topology for view in self.views.values() if view.topology is not None]
        return max(told, key=lambda each: (each.version, each.step, each.issuer), default=None)

    @property
    def carried(self) -> tuple[tuple[str, str], ...]:
        """Return the neighbours of the swarm where the links are not theirs."""
        return self.topology.edges if self.topology is not None and self.topology.links else ()

    @cached_property
    def hubs(self) -> dict[str, list[str]]:
        """Return the robots that each hub calls; empty where links are those of the topology."""
        hubs: dict[str, list[str]] = {}
        for hub, robot in self.topology.links if self.topology is not None else ():
            hubs.setdefault(hub, []).append(robot)
        return hubs

    @cached_property
    def measured_hub(self) -> MeasuredHub | None:
        """Return the hub that measured round trips have chosen, as it tells of itself if it was asked; None where
        nothing is measured."""
        hub = self.topology.hub if self.topology is not None else None
        own = self.views.get(hub.robot) if hub is not None else None
        return own.topology.hub if own is not None and own.topology is not None else hub

    @cached_property
    def replaced(self) -> dict[tuple[str, str], tuple[str, tuple[str, ...]]]:
        """Return the links of hubs that are not up, each with the reason that is known, and the robots with which the
        called robot has other links instead."""
        planned = {pair_of(hub, robot): (hub, robot) for hub, robots in self.hubs.items() for robot in robots}
        spare = [pair for pair in self.round_trips if pair not in planned]
        reasons = {(name, link.peer): link.reason for name, link in self.links() if link.state not in UP}
        found = {}
        for pair, (hub, robot) in planned.items():
            if pair not in self.round_trips:
                others = sorted(end for each in spare if robot in each for end in each if end != robot)
                reason = reasons.get((hub, robot)) or reasons.get((robot, hub)) or "not known why"
                found[hub, robot] = (reason, tuple(others))
        return found

    @cached_property
    def clashes(self) -> dict[str, str]:
        """Return the names that two robots have, as noticed by the robots that were asked, and how."""
        return {
            name: text
            for view in self.views.values()
            if view.links is not None
            for name, text in view.links.clashes.items()
        }

    @cached_property
    def states(self) -> dict[tuple[str, str], bool]:
        """Return every link that is known, its ends sorted, and whether it is up: no end says that it is down, and
        where none was asked, both tell of it."""
        states: dict[tuple[str, str], bool] = {}
        for name, link in self.links():
            pair = pair_of(name, link.peer)
            states[pair] = states.get(pair, True) and link.state in UP
        for name, robot in self.robots.items():
            if robot.state in AWAY:
                continue  # what it said last holds no more
            for peer in robot.links:
                other = self.robots.get(peer)
                if other is not None and other.state not in AWAY and name in other.links:
                    states.setdefault(pair_of(name, peer), True)
        return states

    @cached_property
    def round_trips(self) -> dict[tuple[str, str], float | None]:
        """Return the links that are up: median round-trip time where an end was asked, else twice the larger one-way
        time that the ends tell, in steps of 20 %; s."""
        medians: dict[tuple[str, str], float] = {}
        for name, link in self.links():
            if link.rtt_median is not None:
                pair = pair_of(name, link.peer)
                medians[pair] = max(medians.get(pair, 0.0), link.rtt_median)
        found: dict[tuple[str, str], float | None] = {}
        for pair, up in self.states.items():
            if up:
                told = [
                    robot.links[peer]
                    for name, peer in (pair, pair[::-1])
                    if (robot := self.robots.get(name)) is not None and peer in robot.links
                ]
                found[pair] = medians.get(pair, 2 * max(told) if told else None)
        return found

    @cached_property
    def graph(self) -> Graph:
        """Return the graph of the links that are up."""
        return Graph(self.names, list(self.round_trips))

    @property
    def whole(self) -> bool:
        """Return whether all robots are there, no two with one name, all meshes report, and all known links are up."""
        silent = any(view.links is None for view in self.views.values())
        down = any(link.state != "up" for _, link in self.links())
        return (
            not silent
            and not down
            and not self.clashes
            and not any(robot.state in AWAY for robot in self.robots.values())
        )
