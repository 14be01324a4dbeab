"""The common style of all pictures: colours that colour-blind readers tell apart, light grid, legible in a column.
matplotlib is there where the `lab` extra is, and only imported when it is used."""

import argparse
import contextlib
import itertools
import math
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarm.errors import LocalError, MissingPackageError
from swarm.process.arguments import picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999933")
"""Okabe and Ito's palette and one more."""
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")

DEVICES = " (swarm sim --record and simulate(..., devices=True) record it)"
"""What a message adds where a picture needs what devices say."""

GREY = "0.45"
TIME = "time / s"
"""The label of an axis that shows time."""
NOTE_PT = 8.0
"""Size of notes below a picture. A letter of usual text is less than 0.58 of that wide."""
LEGEND_PT = 8.0
"""Size of the text of legends."""
FEW = len(COLOURS)
"""The most robots that have a colour of their own and a line in the legend."""

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
    "legend.fontsize": LEGEND_PT,
    "savefig.bbox": "tight",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
"""matplotlib's settings. Text stays text in vector files."""


def colour(index: int, count: int) -> Any:
    """Return the colour of one of `count` robots, of the palette, or of a ramp where there are more robots than
    colours."""
    if count <= FEW:
        return COLOURS[index]
    from matplotlib import colormaps

    return colormaps["viridis"](0.95 * index / (count - 1))


def mark(index: int) -> str:
    """Return a marker, for prints without colours."""
    return MARKS[index % len(MARKS)]


def legend(axes: Any, count: int, **options: Any) -> None:
    """Draw a legend of robots above the axes, where no data is, in lines that are no wider than the axes: the layout
    takes the room of a wider one from the axes. With too many robots it would hide the picture."""
    if count <= FEW:
        _, names = axes.get_legend_handles_labels()
        entry = (3.2 + 0.58 * max(map(len, names), default=0)) * LEGEND_PT
        fit = int(72.0 * axes.figure.get_figwidth() / axes.get_subplotspec().get_gridspec().ncols / entry)
        lines = -(-count // max(1, fit))
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "ncols": -(-count // lines), "borderaxespad": 0.2}
        axes.legend(**{**place, "handlelength": 1.4, "columnspacing": 1.0, **options})


def say_below(figure: Any, *notes: str) -> None:
    """Write notes below the picture, each in lines that fit its width."""
    width = int(72.0 * figure.get_figwidth() / (0.58 * NOTE_PT))
    lines = [line for note in notes for line in textwrap.wrap(note, width, break_on_hyphens=False)]
    figure.supxlabel("\n".join(lines), fontsize=NOTE_PT, color=GREY)


def name_points(
    axes: Any,
    points: Sequence[tuple[str, tuple[float, float], Any]],
    marks: Sequence[tuple[float, float]] = (),
    crowd: Sequence[tuple[float, float]] = (),
) -> None:
    """Write a name at each point (name, place, colour), beside it where there is most room: away from the other points,
    from further `marks`, from names already written, and if possible from the `crowd` of places on lines. Call it when
    the axes have their limits."""
    axes.figure.draw_without_rendering()  # a layout that is still to come would move what we measure
    to_pixels = axes.transData.transform
    pixel = axes.figure.dpi / 72
    taken = [tuple(to_pixels(place)) for place in (*(place for _, place, _ in points), *marks)]
    lines = [tuple(to_pixels(place)) for place in crowd]
    for name, place, shade in points:
        x, y = to_pixels(place)
        width, height = 5.2 * pixel * len(name), 8.5 * pixel
        best = None
        for reach, dx, dy in itertools.product((9, 15), (0, 1, -1), (1, 0, -1)):
            if not dx and not dy:
                continue
            middle = (x + dx * (reach * pixel + width / 2), y + dy * (reach * pixel + height / 2))
            apart = min((_room(middle, width, height, each) for each in taken if each != (x, y)), default=1e3)
            passed = sum(_room(middle, width, height, each) <= 0.0 for each in lines)
            score = (min(apart, 12.0 * pixel), -passed, -reach)
            if best is None or score > best[0]:
                best = score, middle, (dx, dy, reach)
        assert best is not None
        _, middle, (dx, dy, reach) = best
        taken += [(middle[0] + part * width / 3, middle[1]) for part in (-1, 0, 1)]
        axes.annotate(
            name,
            place,
            textcoords="offset points",
            xytext=(dx * reach, dy * reach),
            color=shade,
            fontsize=8.5,
            ha=("center", "left", "right")[dx],
            va=("center", "bottom", "top")[dy],
            zorder=7,
            bbox={
                "facecolor": "white",
                "alpha": 0.7,
                "edgecolor": "none",
                "pad": 0.5,
            },  # a stroked name would be no text in SVG
        )


def _room(middle: tuple[float, float], width: float, height: float, point: tuple[float, float]) -> float:
    """Return the distance of a point from a box, in pixels; 0 within it."""
    return math.hypot(max(0.0, abs(point[0] - middle[0]) - width / 2), max(0.0, abs(point[1] - middle[1]) - height / 2))


def integer_ticks(axis: Any) -> None:
    """Give an axis that counts ticks at whole numbers."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))


def rows_of_robots(axes: Any, robots: Sequence[str]) -> None:
    """Give the y axis a row for each robot, the first one at the top."""
    axes.set_yticks(range(len(robots)), robots)
    axes.set_ylim(len(robots) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)


def add_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plot", type=picture, metavar="FILE", help="write a picture: .png, .pdf or .svg")


@contextlib.contextmanager
def figure(
    path: str | Path | None, *, settings: Any = None, in_notebook: bool = False, **options: Any
) -> Iterator["Figure"]:
    """Yield a matplotlib figure that is written to `path` at the end, where there is one; the ending of `path` gives
    the format, and is one of those of the commands (`picture`). `settings` are matplotlib's own. `in_notebook`: a
    notebook shows the figure where its cell ends with it. Raises `LocalError` where the figure cannot be made or
    written."""
    try:
        path = None if path is None else picture(str(path))
    except argparse.ArgumentTypeError as error:
        raise LocalError(str(error)) from None
    try:
        import matplotlib as mpl
    except ImportError:
        raise MissingPackageError("plot" if in_notebook else "--plot", "matplotlib", "lab") from None
    if not in_notebook:
        mpl.use("Agg")  # no display is needed
    from matplotlib import pyplot as plt

    with plt.rc_context(settings or {}):
        made = plt.figure(**options)
        plt.close(made)  # an open figure stays in memory, and a notebook shows it twice
        try:
            yield made
            if path is not None:
                made.savefig(path, dpi=130)
        except (OSError, ValueError) as error:
            raise LocalError(f"{path or 'picture'}: {error}") from None
