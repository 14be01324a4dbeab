"""Pictures of what `bench.apps.apps` measures: `python -m bench.apps.pictures noise|rounds PICTURE.png`.

noise: figure 4.9 of the thesis; rounds: consensus by all algorithms.
"""

import math
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl

from bench.apps.apps import KNOWN_ROUNDS, biased, consensus, localization, place, value
from sim.rehearsal.scene import TARGET

mpl.use("Agg")


def draw(path: Path) -> None:
    """Figure 4.9: estimates and cost over iterations, (a) to (d)."""
    from matplotlib import pyplot as plt

    cases = (
        ("(a) 4e-6, exact", "none", 0.04, 100),
        ("(b) 5e-7, exact", "none", 0.005, 800),
        ("(c) 4e-6, 5 % bias", "bias", 0.04, 100),
        ("(d) 4e-6, 5 % bias and 2 % noise", "thesis", 0.04, 100),
    )
    figure, axes = plt.subplots(2, 4, figsize=(12, 5), layout="constrained", sharey="row")
    for column, (title, model, step, last) in enumerate(cases):
        measure, _ = biased(model, 3, last, 4)
        for algorithm, style in (("thesis", "-"), ("info", "--")):
            parameters = {"step_size": step} if algorithm == "thesis" else {}
            swarm = localization(algorithm, 3, "line", last, measure, **parameters)
            for name, colour in zip(swarm.names, ("#0072b2", "#d55e00", "#009e73"), strict=True):
                errors = [100 * math.dist(place(swarm, name, k), TARGET) for k in range(last + 1)]
                told = f"{algorithm}, {name}" if column == 0 else None
                axes[0, column].plot(errors, style, color=colour, linewidth=1, label=told)
                if algorithm == "thesis":
                    costs: list[Any] = [1e8 * result["cost"] for result in swarm.results[name][1:]]  # type: ignore[operator]
                    axes[1, column].plot(range(1, last + 1), costs, color=colour, linewidth=1)
        axes[0, column].set_title(title, fontsize=10)
        axes[1, column].set_xlabel("iteration")
        for row in axes[:, column]:
            row.set_yscale("log")
            row.grid(alpha=0.3)
    axes[0, 0].set_ylim(0.01, 300)
    axes[1, 0].set_ylim(1e-2, 1e10)
    axes[0, 0].set_ylabel("error / cm")
    axes[1, 0].set_ylabel("cost of the thesis / cm$^4$")
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, dpi=80)


def draw_rounds(path: Path) -> None:
    """Error of all consensus algorithms over iterations, on the line and on thesis-d."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained", sharey=True)
    colours = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000")
    for axis, shape in zip(axes, ("line", "thesis-d"), strict=True):
        for algorithm, colour in zip(KNOWN_ROUNDS, colours, strict=True):
            swarm = consensus(algorithm, 6, shape, 60)
            errors = [max(abs(value(swarm, name, k) - 15.5 / 6) for name in swarm.names) for k in range(swarm.k + 1)]
            axis.plot([max(error, 1e-12) for error in errors], color=colour, label=algorithm, linewidth=1.4)
        axis.axhline(1e-2, color="0.7", linewidth=0.8)
        axis.set(xlabel="iteration", title=f"{shape}, six robots", yscale="log", ylim=(1e-6, 5))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("largest distance from the mean")
    axes[1].legend(fontsize=8)
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    {"noise": draw, "rounds": draw_rounds}[sys.argv[1]](Path(sys.argv[2]))
