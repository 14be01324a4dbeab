"""Gradient tracking of the thesis, eqs 4.3-4.6 (after Nedic, Olshevsky, Shi 2016): one robot's iteration.

In metres: the step size gamma is in 1/m^2, that is 10^4 times the thesis' value in 1/cm^2. Eq 4.2 lacks a
square: the cost that 4.3 is the gradient of is (phi^2 - |x - p|^2)^2.
"""

from collections.abc import Iterable

from swarm.frozen import frozen

Vector2 = tuple[float, float]
"""Two numbers."""


@frozen
class Node:
    """The 48 bytes that a robot shares."""

    x: Vector2 = (0.0, 0.0)
    """Estimate of the target, m."""
    z: Vector2 = (0.0, 0.0)
    """Auxiliary variable of the tracking, m."""
    g: Vector2 = (0.0, 0.0)
    """Own gradient at x, m^3."""


def gradient(x: Vector2, distance: float, place: Vector2) -> Vector2:
    """Eq 4.3 / 4.6: 4 (phi^2 - |x - p|^2) (p - x), m^3."""
    dx, dy = place[0] - x[0], place[1] - x[1]
    residual = 4.0 * (distance * distance - dx * dx - dy * dy)
    return residual * dx, residual * dy


def cost(x: Vector2, distance: float, place: Vector2) -> float:
    """(phi^2 - |x - p|^2)^2, m^4."""
    dx, dy = place[0] - x[0], place[1] - x[1]
    residual = distance * distance - dx * dx - dy * dy
    return residual * residual


def iterate(own: Node, weighted: Iterable[tuple[float, Node]], gamma: float, distance: float, place: Vector2) -> Node:
    """Algorithm 4. `weighted`: row-normalised weights and nodes of the neighbours and of the robot itself."""
    x = y = z = t = 0.0
    for w, node in weighted:
        x += w * node.x[0]
        y += w * node.x[1]
        z += w * (node.z[0] + gamma * node.g[0])
        t += w * (node.z[1] + gamma * node.g[1])
    new = (x - own.z[0] - gamma * own.g[0], y - own.z[1] - gamma * own.g[1])
    return Node(new, (z - gamma * own.g[0], t - gamma * own.g[1]), gradient(new, distance, place))
