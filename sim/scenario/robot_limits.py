"""The limits of real robots that a simulated run exceeds, printed before it starts.

A state or message too large for a frame is refused by simulations, too, where the app is loaded.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from services.apps import loader
from services.mesh.core.routing.physical_links import physical
from sim.scenario import imports
from swarm.config.types import MAX_RFCOMM_LINKS, Config
from swarm.core.graph import Edge


def too_many_links(names: Sequence[str], edges: Sequence[Edge], links: str) -> Iterator[str]:
    """Tell which robots have more links than a Bluetooth radio holds; `links` is the way they carry the topology."""
    counts = Counter(name for edge in physical(names, edges, links) for name in edge)
    crowded = [name for name in names if counts[name] > MAX_RFCOMM_LINKS]
    if crowded:
        most = max(counts.values())
        yield (
            f"real robots would refuse this topology: {', '.join(crowded[:6])}{', ...' if len(crowded) > 6 else ''} "
            f"with up to {most} links, and a Bluetooth radio holds {MAX_RFCOMM_LINKS}; --links tree carries it"
        )


def lacking_modules(config: Config, app: loader.LoadedApp) -> Iterator[str]:
    """Tell what an app of the user's imports that robots lack."""
    if not app.is_built_in and Path(app.source).is_file():  # a notebook's cell is no file
        yield from imports.lacking(app.source, (*config.packages, *imports.own_packages()))
