"""How all pictures look and are written: colours that colour-blind readers tell apart, light grid, legible in a
column. matplotlib is there where the `lab` extra is, and only imported when it is used.
"""

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from swarm.errors import LocalError

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999933")
"""Okabe and Ito's palette and one more."""
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")

GREY = "0.45"
FEW = len(COLOURS)
"""Robots up to which each has a colour of its own and a line in the legend."""

RC = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "savefig.bbox": "tight",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
"""matplotlib's settings. Text stays text in vector files."""


def colour(index: int, count: int) -> Any:
    """The colour of one of `count` robots: of the palette, or of a ramp where there are more."""
    if count <= FEW:
        return COLOURS[index]
    from matplotlib import colormaps

    return colormaps["viridis"](0.95 * index / (count - 1))


def mark(index: int) -> str:
    """A marker, for those who print in grey."""
    return MARKS[index % len(MARKS)]


def legend(axes: Any, count: int, **options: Any) -> None:
    """A legend of robots above the axes, where no data is; with too many robots it would hide the picture."""
    if count <= FEW:
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "ncols": count, "borderaxespad": 0.2}
        axes.legend(**{**place, "handlelength": 1.4, "columnspacing": 1.0, **options})


def whole(axis: Any) -> None:
    """Ticks of an axis that counts."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))


def rows_of_robots(axes: Any, robots: Sequence[str]) -> None:
    """The y axis has a row for each robot, the first one at the top."""
    axes.set_yticks(range(len(robots)), robots)
    axes.set_ylim(len(robots) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def add_plot(parser: argparse.ArgumentParser) -> None:
    """Declare `--plot`."""
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw it: .png, .pdf or .svg")


@contextlib.contextmanager
def figure(path: Path, *, settings: Any = None, **options: Any) -> Iterator[Any]:
    """A matplotlib figure that is written to `path` in the end; its ending says in which format. `settings` are
    matplotlib's own. Raises `LocalError` where that cannot be done."""
    try:
        import matplotlib as mpl
    except ImportError:
        raise LocalError('--plot needs matplotlib: pip install "balboa-swarm[lab]"') from None
    mpl.use("Agg")  # no display is needed
    from matplotlib import pyplot as plt

    with plt.rc_context(settings or {}):
        made = plt.figure(**options)
        try:
            yield made
            made.savefig(path, dpi=130)
        except (OSError, ValueError) as error:
            raise LocalError(f"{path}: {error}") from None
        finally:
            plt.close(made)
