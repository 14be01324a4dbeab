"""`swarm plot RUN`: a picture of a recorded run."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from laptop.plotting import events, journeys, mesh, places, states, style
from laptop.plotting.style import figure
from swarm.errors import LocalError
from swarm.onboard.arguments import add_json, show
from swarm.recording.run import Run

HELP = "draw a recorded run: states, map, mesh, LEDs, floods, ..."

KINDS: dict[str, Callable[[Any, Run], None]] = {
    "states": states.states,
    "iterations": states.iterations,
    "map": places.scene,
    "mesh": mesh.mesh,
    "leds": events.leds,
    "floods": journeys.floods,
    "unicasts": journeys.unicasts,
    "standup": events.standup,
}

TIME = "time / s"
"""How an axis of the run's time is labelled."""

OF_APP = {
    "localization": "map",
    "formation": "map",
    "goto": "map",
    "led_sync": "leds",
    "stand_up": "standup",
    "flooding_demo": "floods",
    "unicast_demo": "unicasts",
}
"""What is drawn of an app where nothing is asked for; of others: states."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The run, what to draw, and where."""
    parser.add_argument("run", type=Path, metavar="RUN", help="its folder, or one recording (.mcap)")
    parser.add_argument("--kind", choices=KINDS, help="what to draw (by the app)")
    parser.add_argument(
        "--app", default="", metavar="NAME", help="where robots ran several (the one that the run is about)"
    )
    parser.add_argument("--column", action="append", default=[], metavar="NAME", help="of the states, may be repeated")
    parser.add_argument(
        "--label",
        action="append",
        default=[],
        metavar="NAME=TEXT",
        help='what stands at the axis of a state, e.g. "value=x / m"',
    )
    parser.add_argument("--between", nargs=2, type=float, metavar=("FROM", "TO"), help="only this time of the run, s")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="PNG, PDF or SVG (RUN-KIND.png)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """0; an error where there is nothing to draw."""
    recorded = Run(args.run, args.app)
    labels = dict(_label(text) for text in args.label)
    kind = args.kind or ("states" if args.column or labels else _of(recorded))
    drawing = partial(states.states, columns=args.column, labels=labels) if kind == "states" else KINDS[kind]
    name = "-".join(filter(None, (args.run.resolve().stem, args.app, kind)))
    path = args.output or Path(f"{name}.png")
    with figure(path, settings=style.RC, layout="constrained") as made:
        drawing(made, recorded)
        for axes in made.axes if args.between else ():
            if axes.get_xlabel() == TIME:
                axes.set_xlim(*args.between)
    damage = list(recorded.damage)
    show(args, {"picture": str(path), "damage": damage}, [*(f"note: {each}" for each in damage), str(path)])
    return 0


def draw(run: Path, app: str, path: Path) -> None:
    """Draw what is drawn of a recorded run of an app where nothing else is asked for."""
    recorded = Run(run, app)
    with figure(path, settings=style.RC, layout="constrained") as made:
        KINDS[_of(recorded)](made, recorded)


def _label(text: str) -> tuple[str, str]:
    name, equals, label = text.partition("=")
    if not equals or not name:
        raise LocalError(f'--label {text}: expected NAME=TEXT, e.g. "value=x / m"')
    return name, label


def _of(recorded: Run) -> str:
    kind = OF_APP.get(recorded.app, "states")
    # Imported from the thesis' files there are states alone.
    needed = {"leds": "/leds", "standup": "/balancer/state", "floods": "/asked", "unicasts": "/asked"}.get(kind, "")
    return kind if any(topic.endswith(needed) for topic in recorded.topics) else "states"
