"""The largest step size at which the thesis' gradient tracking converges, for the graph and the places at hand.

There is no useful bound in closed form: the cost is a quartic, so the limit depends on the start, and on the graph
through the weights. It is found by running the iteration itself, with exact ranges, and bisecting the step size.
"""

import math
from collections.abc import Mapping, Sequence

from services.apps.localization.gradient import Node, Vector2, iterate
from swarm.core.graph import Graph
from swarm.errors import AppError

MARGIN = 0.9
"""Share of the limit that is taken as safe with measurement noise, which moves the limit."""

_ITERATIONS = 400  # divergence takes some tens
_WINDOW = 100
_SHRINKS = 0.97  # of one window's largest error, in the next: a limit cycle keeps its size
_SETTLED = 0.01  # of the way from the start to the target, for all robots
_ESCAPED = 10.0  # times the size of the scene
_PRECISION = 0.01


def limit_step_size(graph: Graph, places: Mapping[str, Vector2], target: Vector2, start: Vector2 = (0.0, 0.0)) -> float:
    """The limit of gamma in 1/m^2, within one percent; `places` of the robots by name and `target` in m.

    The limit goes with 1 / size^2: a scene of 1 m, say, allows four times the step of one of 2 m.
    """
    weights = [_row(graph, name) for name in graph.names]
    here = [places[name] for name in graph.names]
    ranges = [math.dist(place, target) for place in here]
    way = math.dist(start, target)
    size = max(way, *ranges)
    if way == 0.0:
        raise AppError("no step size can be worked out: the iteration starts at the target")

    def settles(gamma: float) -> bool:
        nodes = [Node(start) for _ in here]
        errors: list[float] = []
        for _ in range(_ITERATIONS):
            nodes = [
                iterate(own, [(w, nodes[j]) for j, w in row], gamma, phi, place)
                for own, row, phi, place in zip(nodes, weights, ranges, here, strict=True)
            ]
            worst = max(math.dist(node.x, target) for node in nodes)
            if not worst < _ESCAPED * size:
                return False
            if worst < _SETTLED * way:
                return True
            errors.append(worst)
        # Large graphs settle slowly, so getting nearer is enough.
        return max(errors[-_WINDOW:]) < _SHRINKS * max(errors[-2 * _WINDOW : -_WINDOW])

    high = 1.0 / size**2
    while settles(high):
        high *= 2.0
    low = high / 2.0
    while not settles(low):
        high, low = low, low / 2.0
        if low * size**2 < 1e-6:
            raise AppError("gradient tracking does not converge from this start at any step size (robots in line?)")
    while high > low * (1.0 + _PRECISION):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if settles(middle) else (low, middle)
    return low


def check_step_size(gamma: float, limit: float) -> str | None:
    """A warning for a gamma (1/m^2) above what is safe; `AppError` for one above the limit itself."""
    text = f"step size {gamma:.3g} 1/m^2 ({gamma * 1e-4:.3g} 1/cm^2)"
    bound = f"limit of this graph and geometry, {limit:.3g} 1/m^2 ({limit * 1e-4:.3g} 1/cm^2)"
    if gamma > limit:
        raise AppError(f"{text} is above the {bound}: gradient tracking would diverge")
    if gamma > MARGIN * limit:
        return f"{text} is above {MARGIN:g} of the {bound}: with noise it may diverge"
    return None


def _row(graph: Graph, name: str) -> Sequence[tuple[int, float]]:
    """Row-normalised weights of one robot, itself first, by index."""
    weights = graph.row_weights(name)
    own = 1.0 - math.fsum(weights.values())
    place = {other: i for i, other in enumerate(graph.names)}
    return [(place[name], own), *((place[other], w) for other, w in weights.items())]
