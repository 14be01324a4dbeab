"""`swarm dwm check --truth KEY`: the errors of a robot's poses and ranges against a truth that another source says."""

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from services.dwm.core.estimation.truth import TruthComparison
from services.dwm.line import BusLine
from swarm import clock
from swarm.config import Config
from swarm.errors import BusError, PayloadError
from swarm.messages import ExternalReport, Pose, Ranges, Truth
from swarm.messages.codec import decode
from swarm.messages.keys import key

SECONDS = 10.0
PATIENCE_S = 5.0


def key_of(text: str, robot: str) -> str:
    """Return the key of the truth: `{robot}` stands for the name; one that is not below `swarm/` is a topic of the
    robot."""
    name = text.replace("{robot}", robot)
    return name if name.startswith("swarm/") else key(robot, *name.split("/"))


def compare(line: BusLine, config: Config, truth: str, seconds: float, wait: Callable[[float], None]) -> dict[str, Any]:
    """Listen for some seconds and return `TruthComparison.result`. Raises `BusError` where the bus does not answer."""
    robot = line.name
    anchors = {each.address: (each.x, each.y, each.z - config.dwm.height) for each in config.anchors}
    comparison, lock = TruthComparison(anchors), threading.Lock()
    source = key_of(truth, robot)

    def take(name: str, payload: bytes) -> None:
        with contextlib.suppress(PayloadError), lock:
            if name == source:
                comparison.truth(*_truth(name, payload, simulated=source == key(robot, "sim", "truth")))
            elif name == key(robot, "dwm", "pose"):
                comparison.pose(decode(Pose, payload, name))
            else:
                comparison.ranges(decode(Ranges, payload, name))

    line.bus.subscribe([source, key(robot, "dwm", "pose"), key(robot, "dwm", "ranges")], take)
    if not line.bus.wait_connected(PATIENCE_S):
        raise BusError(f"{robot}: its bus does not answer: does its bus service run?")
    wait(seconds)
    with lock:
        return comparison.result()


def _truth(name: str, payload: bytes, *, simulated: bool) -> tuple[float, float, float]:
    """Time, x and y of a report; raises `PayloadError` where it holds no place."""
    if simulated:
        true = decode(Truth, payload, name)
        return true.t, true.x, true.y
    report = decode(ExternalReport, payload, name)
    if report.x is None or report.y is None:
        raise PayloadError(f"{name}: no place")
    return clock.now() - report.age, report.x, report.y


def lines_of(robot: str, truth: str, found: dict[str, Any]) -> list[str]:
    """Return the lines for people, in cm."""
    if not found["truths"]:
        return [f"{robot}: nothing is heard on {key_of(truth, robot)}: does the bridge run? it names places as x and y"]
    if found["pose"] is None:
        return [f"{robot}: no pose of the time of a truth: swarm dwm check --robots {robot} tells why"]
    pose = found["pose"]
    x, y = pose["mean_m"]
    return [
        f"{robot}: {pose['count']} poses: error {100 * pose['rms_m']:.1f} cm rms, "
        f"90 % within {100 * pose['p90_m']:.1f}; mean ({100 * x:+.1f}, {100 * y:+.1f})",
        *(
            f"  {name}: {row['count']} ranges, {100 * row['mean_m']:+.1f} cm on the mean, "
            f"deviation {100 * row['deviation_m']:.1f}"
            for name, row in found["ranges"].items()
        ),
    ]
