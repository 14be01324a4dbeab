"""The largest step size at which the thesis' gradient tracking converges, for the graph and the places at hand.

There is no useful bound in closed form: the cost is a quartic, so the limit depends on the start, and on the graph
through the weights. It is found by running the iteration itself, with exact ranges, and bisecting the step size.
"""

import math
from collections.abc import Mapping, Sequence

from services.apps.builtin.localization.gradient import Node, Vector2, iterate
from swarm.config.types import Anchor
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.frozen import frozen

MARGIN = 0.9
"""Share of the limit that is taken as safe with measurement noise, which moves the limit."""

_ITERATIONS = 400  # divergence takes some tens
_WINDOW = 100
_SHRINKS = 0.97  # of one window's largest error, in the next: a limit cycle keeps its size
_SETTLED = 0.01  # of the way from the start to the target, for all robots
_ESCAPED = 10.0  # times the size of the scene
_PRECISION = 0.01


BOUND = 2.7e-2
"""1/m^2: the lowest of the limits on the thesis' graphs (random, six robots) on its table; 2.7e-6 1/cm^2."""

TABLE = 2.0
"""m: the side of that table."""

_PLACES = ((0.5, 1.5), (1.0, 0.5), (1.5, 1.5))
_TARGET = (0.5, 1.0)


@frozen
class Scene:
    """The geometry on which the limit depends, m, by the index of the robot."""

    weights: tuple[tuple[tuple[int, float], ...], ...]
    """The weights of each robot: of its neighbours and of itself."""
    places: tuple[Vector2, ...]
    target: Vector2
    start: Vector2 = (0.0, 0.0)

    def settles(self, gamma: float) -> bool:
        """Return whether the iteration with exact ranges comes to the target with this step size, 1/m^2."""
        distances = [math.dist(place, self.target) for place in self.places]
        way = math.dist(self.start, self.target)
        nodes = [Node(self.start) for _ in self.places]
        errors: list[float] = []
        for _ in range(_ITERATIONS):
            nodes = [
                iterate(own, [(w, nodes[j]) for j, w in row], gamma, phi, place)
                for own, row, phi, place in zip(nodes, self.weights, distances, self.places, strict=True)
            ]
            worst = max(math.dist(node.x, self.target) for node in nodes)
            if not worst < _ESCAPED * self.size:
                return False
            if worst < _SETTLED * way:
                return True
            errors.append(worst)
        # Large graphs settle slowly, so getting nearer is enough.
        return max(errors[-_WINDOW:]) < _SHRINKS * max(errors[-2 * _WINDOW : -_WINDOW])

    @property
    def size(self) -> float:
        """The longest way in it, m."""
        ways = (math.dist(place, self.target) for place in self.places)
        return max(math.dist(self.start, self.target), *ways)


def limit_step_size(
    graph: Graph,
    places: Mapping[str, Vector2],
    target: Vector2,
    start: Vector2 = (0.0, 0.0),
    *,
    metropolis: bool = False,
) -> float:
    """Return the limit of gamma in 1/m^2, within one percent; `places` of the robots by name and `target` in m.

    The limit goes with 1 / size^2: a scene of 1 m, say, allows four times the step of one of 2 m.
    """
    if math.dist(start, target) == 0.0:
        raise AppError("no step size can be worked out: the iteration starts at the target")
    scene = Scene(_rows(graph, metropolis=metropolis), tuple(places[name] for name in graph.names), target, start)
    size = scene.size
    high = 1.0 / size**2
    while scene.settles(high):
        high *= 2.0
    low = high / 2.0
    while not scene.settles(low):
        high, low = low, low / 2.0
        if low * size**2 < 1e-6:
            raise AppError("gradient tracking does not converge from this start at any step size (robots in line?)")
    while high > low * (1.0 + _PRECISION):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if scene.settles(middle) else (low, middle)
    return low


def check_start(graph: Graph, anchors: Sequence[Anchor], gamma: float, *, metropolis: bool) -> None:
    """Check gamma (1/m^2) before any robot has told its place. Raises `AppError` where it is too large.

    0.9 of `BOUND`, scaled to the size of the anchors' field, is safe on all of the thesis' graphs. A larger one has to
    settle, with the same margin, in the thesis' scene of that size, which is of three robots: 4e-6 1/cm^2 does on a
    line. With six robots and the thesis' noise that step size diverges in up to all of the runs.
    """
    scale = _side(anchors) / TABLE
    bound = MARGIN * BOUND / scale**2
    if gamma <= bound:
        return
    if len(graph.names) <= len(_PLACES):
        places = tuple((scale * x, scale * y) for x, y in _PLACES[: len(graph.names)])
        target = (scale * _TARGET[0], scale * _TARGET[1])
        if Scene(_rows(graph, metropolis=metropolis), places, target).settles(gamma / MARGIN):
            return
    raise AppError(
        f"step_size {gamma:.3g} 1/m^2 ({gamma * 1e-4:.3g} 1/cm^2) is too large for this graph on a field of "
        f"{scale * TABLE:.3g} m: gradient tracking may diverge. Safe is {bound:.3g} 1/m^2 ({bound * 1e-4:.3g} 1/cm^2); "
        "check = false runs it all the same"
    )


def check_step_size(gamma: float, limit: float) -> str | None:
    """Return a warning for a gamma (1/m^2) above the safe part of the limit. Raises `AppError` above the limit
    itself."""
    text = f"step size {gamma:.3g} 1/m^2 ({gamma * 1e-4:.3g} 1/cm^2)"
    bound = f"limit of this graph and geometry, {limit:.3g} 1/m^2 ({limit * 1e-4:.3g} 1/cm^2)"
    if gamma > limit:
        raise AppError(f"{text} is above the {bound}: gradient tracking would diverge")
    if gamma > MARGIN * limit:
        return f"{text} is above {MARGIN:g} of the {bound}: with noise it may diverge"
    return None


def _rows(graph: Graph, *, metropolis: bool) -> tuple[tuple[tuple[int, float], ...], ...]:
    """Return the weights of all robots, each one's own first, by index."""
    place = {name: i for i, name in enumerate(graph.names)}
    rows = []
    for name in graph.names:
        weights = graph.metropolis_weights(name) if metropolis else graph.row_weights(name)
        own = 1.0 - math.fsum(weights.values())
        rows.append(((place[name], own), *((place[other], w) for other, w in weights.items())))
    return tuple(rows)


def _side(anchors: Sequence[Anchor]) -> float:
    """Longer side of the field the anchors stand around, m; without any, the table's."""
    if len(anchors) < 2:
        return TABLE
    xs, ys = [anchor.x for anchor in anchors], [anchor.y for anchor in anchors]
    return max(max(xs) - min(xs), max(ys) - min(ys)) or TABLE
