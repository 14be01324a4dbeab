"""`swarm plot RUN`: a picture of a recorded run."""

import argparse
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from laptop.plotting import events, journeys, mesh, places, states, style
from swarm.errors import LocalError
from swarm.process.arguments import add_json, picture, show
from swarm.recording.run import Run

HELP = "draw a recorded run: states, map, mesh, LEDs, floods, ..."

KINDS: dict[str, Callable[[Any, Run], None]] = {
    "states": states.states,
    "iterations": states.iterations,
    "map": places.draw_map,
    "mesh": mesh.mesh,
    "leds": events.leds,
    "floods": journeys.floods,
    "unicasts": journeys.unicasts,
    "standup": events.standup,
}

OF_APP = {
    "localization": "map",
    "formation": "map",
    "goto": "map",
    "led_sync": "leds",
    "stand_up": "standup",
    "flooding_demo": "floods",
    "unicast_demo": "unicasts",
}
"""The default kind of picture of a built-in app; of all others it is the states."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the run, what to draw of it, and the file."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or one recording (.mcap)")
    parser.add_argument("--kind", choices=KINDS, help="kind of picture (default: the app chooses)")
    parser.add_argument(
        "--app", default="", metavar="NAME", help="app to plot, if robots ran several (default: the run's first app)"
    )
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME",
        help="name of a state or result to draw; may be repeated",
    )
    parser.add_argument(
        "--label",
        action="append",
        default=[],
        metavar="NAME=TEXT",
        help='label at the axis of a state, e.g. "value=x / m"',
    )
    parser.add_argument(
        "--between", nargs=2, type=float, metavar=("FROM", "TO"), help="draw only this part of the run, in s"
    )
    parser.add_argument(
        "-o", "--output", type=picture, metavar="FILE", help="file to write: PNG, PDF or SVG (RUN-KIND.png)"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Draw the run and return 0. Raises `LocalError` where there is nothing to draw."""
    recorded = Run(args.run, args.app)
    labels = dict(_label(text) for text in args.label)
    kind = args.kind or ("states" if args.column or labels else _of(recorded))
    _check(kind, args.column or labels)
    drawing = (
        partial(states.states, columns=args.column, labels=labels, between=args.between)
        if kind == "states"
        else KINDS[kind]
    )
    name = "-".join(filter(None, (args.run.resolve().stem, args.app, kind)))
    path = args.output or Path(f"{name}.png")
    with style.figure(path, settings=style.RC, layout="constrained") as made:
        try:
            drawing(made, recorded)
            if args.between:
                _cut(made, *args.between)
        except LocalError as error:  # the damaged part may be what the picture needs
            raise LocalError("; ".join([f"{args.run}: {error}", *recorded.damage])) from None
    damage = list(recorded.damage)
    show(args, {"picture": str(path), "damage": damage}, [*(f"note: {each}" for each in damage), str(path)])
    return 0


def draw(run: Path, app: str, path: Path, references: Mapping[str, Sequence[places.Place]] | None = None) -> None:
    """Draw a recorded run of an app as `swarm plot` does by default, and beside estimates of a target the `references`,
    by robot."""
    recorded = Run(run, app)
    with style.figure(path, settings=style.RC, layout="constrained") as made:
        if references and _of(recorded) == "map":
            places.draw_map(made, recorded, references)
        else:
            draw_on(made, recorded, None, ())


def draw_on(made: Any, recorded: Run, kind: str | None, columns: Sequence[str]) -> None:
    """Draw a run on a figure: these columns of its states, a picture of this kind, or what suits its app. Raises
    `LocalError`."""
    kind = kind or ("states" if columns else _of(recorded))
    _check(kind, columns)
    if kind == "states":
        states.states(made, recorded, columns)
    else:
        KINDS[kind](made, recorded)


def _check(kind: str, columns: Collection[str]) -> None:
    """Raise `LocalError` where there is no such picture, or none with columns."""
    if kind not in KINDS:
        raise LocalError(f"there is no picture of kind {kind!r}; there are: {', '.join(KINDS)}")
    if columns and kind != "states":
        raise LocalError(f"columns and their labels belong to a picture of kind states, not to {kind}")


def _cut(made: Any, begin: float, end: float) -> None:
    """Show only the part of a figure from `begin` to `end`, s. Raises `LocalError` where nothing is drawn there."""
    over_time = [axes for axes in made.axes if axes.get_xlabel() == style.TIME]
    if not over_time:
        raise LocalError("--between: nothing in this picture is drawn over time")
    first, last = (choose(axes.dataLim.intervalx[i] for axes in over_time) for i, choose in enumerate((min, max)))
    if not (begin < end and begin <= last and first <= end):
        raise LocalError(f"--between {begin:g} {end:g}: expected FROM < TO within {first:.6g} s to {last:.6g} s")
    for axes in over_time:
        axes.set_xlim(begin, end)


def _label(text: str) -> tuple[str, str]:
    name, equals, label = text.partition("=")
    if not equals or not name:
        raise LocalError(f'--label {text}: expected NAME=TEXT, e.g. "value=x / m"')
    return name, label


def _of(recorded: Run) -> str:
    kind = OF_APP.get(recorded.built_in, "states")
    # A run that was imported from the thesis' files has states alone.
    needed = {"leds": "/leds", "standup": "/balancer/state", "floods": "/asked", "unicasts": "/asked"}.get(kind, "")
    return kind if any(topic.endswith(needed) for topic in recorded.topics) else "states"
