"""The decisions of `swarm pair`: which robots are paired, in what order, and what the config says of their
addresses."""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import combinations

from services.mesh.core.routing.physical_links import links_of
from swarm.config.types import GRAPH, Config
from swarm.core.graph import Edge
from swarm.frozen import frozen


@frozen
class Bond:
    """One robot's record of another robot, by its bluetoothd."""

    paired: bool = False
    trusted: bool = False


def bluetooth_links(config: Config, robots: Collection[str]) -> list[Edge]:
    """Return the Bluetooth links between these robots. They are those of the topology, or all pairs where any robot may
    call another: where robots find links themselves, and where hubs with successors carry the topology.

    A link is Bluetooth's where either end has no `link`.
    """
    radio = {robot.name for robot in config.robots if robot.link is None}
    all_bluetooth = all(robot.link is None for robot in config.robots)  # addresses may still be unknown
    any_pair = config.auto or links_of(config, bluetooth=all_bluetooth) != GRAPH
    pairs = combinations(config.names, 2) if any_pair else config.edges
    return [(a, b) for a, b in pairs if {a, b} & radio and a in robots and b in robots]


def check(config: Config, addresses: Mapping[str, str]) -> dict[str, str]:
    """Explain by robot what is wrong where adapters have these addresses: the config has another, or two have the
    same."""
    wrong = {}
    for name, address in addresses.items():
        said = config.robot(name).bluetooth
        owner = next((robot.name for robot in config.robots if robot.bluetooth == address and robot.name != name), None)
        twin = next((other for other, its in addresses.items() if its == address and other != name), None)
        if twin is not None:
            wrong[name] = f"it and {twin} are the same robot, or have the same address {address}"
        elif owner is not None:
            wrong[name] = (
                f"its address {address} is that of {owner} in {config.path.name}: one of them is another robot"
            )
        elif said is not None and said != address:
            wrong[name] = (
                f"its address is {address}, {config.path.name} says {said}: mend it, or give the robot its name"
            )
    return wrong


def plan(a: Bond | None, b: Bond | None) -> list[str]:
    """Return the steps for a link whose ends know each other so (None: not at all), in order.

    forget-a, forget-b: remove what is left of a pairing the other end knows nothing of; pair; trust-a, trust-b.
    """
    paired = [end is not None and end.paired for end in (a, b)]
    if not all(paired):
        # Other knowledge of an end about the other is from earlier pairings: an inquiry begins with none.
        return [*(f"forget-{end}" for end, its in zip("ab", (a, b), strict=True) if its is not None), "pair"]
    return [f"trust-{end}" for end, its in zip("ab", (a, b), strict=True) if its is not None and not its.trusted]


@dataclass
class PairingSchedule:
    """A schedule of the links to pair. No robot has two at once: one radio does one thing at a time."""

    waiting: list[Edge]
    busy: set[str] = field(default_factory=set)

    def start(self) -> list[Edge]:
        """Return the links that can be begun. Their robots are busy until `done`."""
        begun = []
        for edge in list(self.waiting):
            if not self.busy & set(edge):
                self.busy |= set(edge)
                self.waiting.remove(edge)
                begun.append(edge)
        return begun

    def done(self, edge: Edge) -> None:
        """Let the robots of this link be paired with others."""
        self.busy -= set(edge)


def ordered(pairs: Iterable[Edge], addresses: Mapping[str, str]) -> list[Edge]:
    """Return the pairs with the lower address first: that robot calls, as it does when the mesh runs."""
    return [(a, b) if addresses[a] < addresses[b] else (b, a) for a, b in pairs]


def with_addresses(text: str, addresses: Mapping[str, str]) -> str:
    """Return the text of a swarm.toml with a line `bluetooth = "..."` below the names of these robots; the rest is
    untouched.

    Robots whose name stands in another form than `name = "r0"` on a line of its own are left alone.
    """
    lines, out, table = text.splitlines(keepends=True), [], ""
    for line in lines:
        out.append(line)
        if header := re.match(r"\s*(\[\[?[^\]]+\]\]?)", line):
            table = header[1].replace(" ", "")
        name = re.match(r"""\s*name\s*=\s*["']([^"']+)["']\s*(#.*)?$""", line)
        if table == "[[robots]]" and name and name[1] in addresses:
            if not line.endswith("\n"):
                out.append("\n")
            out.append(f'bluetooth = "{addresses[name[1]]}"\n')
    return "".join(out)
