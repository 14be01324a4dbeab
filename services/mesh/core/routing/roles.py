"""Who calls whom on Bluetooth, so that robots are in few piconets.

Who calls is the central of a piconet with all that it calls, and a robot in several piconets is in one at a time. So a
robot should either call all its neighbours or be called by them: on a graph of two sides one side calls. On other
graphs calls are turned one by one as long as that makes waiting shorter. All robots find the same, from their
configuration.
"""

from collections.abc import Sequence

from swarm.core.graph import Edge

CENTRAL, PERIPHERAL = "central", "peripheral"
"""The role that who calls is to have, and that of who is called."""

MOST = 32
"""Links of a graph up to which calls are turned; beyond, the sides alone decide."""


def callers(names: Sequence[str], edges: Sequence[Edge]) -> frozenset[Edge]:
    """Of each link who calls, first."""
    near: dict[str, list[str]] = {name: [] for name in names}
    for a, b in edges:
        near[a].append(b)
        near[b].append(a)
    # The side with more links a robot is called less: in a star the hub calls, as the robot with most neighbours.
    calls: dict[str, bool] = {}
    for first in sorted(names, key=lambda name: (-len(near[name]), name)):
        todo = [first] if first not in calls else []
        calls.setdefault(first, True)
        for here in todo:
            for other in sorted(near[here]):
                if other not in calls:
                    calls[other] = not calls[here]
                    todo.append(other)
    links = [(a, b) if (not calls[a], a) < (not calls[b], b) else (b, a) for a, b in sorted(map(_sorted, edges))]
    return frozenset(_turned(links) if len(links) <= MOST else links)


def _sorted(edge: Edge) -> Edge:
    return (min(edge), max(edge))


def _turned(links: list[Edge]) -> list[Edge]:
    """Turn calls while that helps."""
    best, better = waiting(links), True
    while better:
        better = False
        for place, (caller, called) in enumerate(links):
            links[place] = called, caller
            if (found := waiting(links)) < best:
                best, better = found, True
            else:
                links[place] = caller, called
    return links


def piconets(links: Sequence[Edge]) -> dict[str, int]:
    """In how many each robot is."""
    found: dict[str, set[str]] = {}
    for caller, called in links:
        found.setdefault(caller, set()).add(caller)
        found.setdefault(called, set()).add(caller)
    return {name: len(each) for name, each in found.items()}


def waiting(links: Sequence[Edge]) -> tuple[int, int]:
    """How long frames wait for both ends to be in a link's piconet, as the product of the ends' piconets: of the worst
    link, and of all together."""
    number = piconets(links)
    each = [number[caller] * number[called] for caller, called in links]
    return max(each, default=0), sum(each)
