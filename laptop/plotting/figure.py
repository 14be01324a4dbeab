"""Pictures of commands: matplotlib is there where the `lab` extra is, and only imported when it is used."""

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from swarm.errors import LocalError


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
