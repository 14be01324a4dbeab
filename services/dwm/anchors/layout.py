"""`swarm dwm anchors --auto`: the anchors' places from the distances between them. For the laptop: it needs numpy."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from services.dwm import configure
from services.dwm.anchors import survey
from services.dwm.anchors.autoposition import Layout, Pair, align, locate
from services.dwm.core.module.tlv import LOC_GET
from services.dwm.line import ModuleConnection
from swarm.config import Config
from swarm.errors import LocalError

POOR = 0.10
"""Root mean square of the residuals beyond which the layout is not trusted, m."""


def lay_out(
    args: argparse.Namespace,
    config: Config | None,
    lines: Sequence[ModuleConnection],
    calibrate: survey.Calibrate,
    wait: Callable[[float], None],
) -> int:
    """Measure, or read, the distances, and print the anchors as swarm.toml wants them; 1 where they fit badly."""
    heights = {anchor.address: anchor.z for anchor in config.anchors} if config else {}
    listed = {anchor.address: (anchor.x, anchor.y) for anchor in config.anchors} if config else {}
    distances = read(args.ranges) if args.ranges else _measure(args, list(listed), lines, calibrate, wait)
    layout = locate(distances, heights)
    if sum(name in listed for name in layout.places) >= 3:
        layout = align(layout, listed)
    if args.json:
        residuals = {f"{one} {other}": value for (one, other), value in layout.residuals.items()}
        found = {"anchors": layout.places, "heights": heights, "rms": layout.rms, "residuals": residuals}
        sys.stdout.write(json.dumps(found) + "\n")
    else:
        sys.stdout.write(_text(layout, heights))
    return 1 if layout.rms > POOR else 0


def read(path: Path) -> dict[Pair, float]:
    """Distances from a file of lines `D001 D002 1.94`, in m; `#` begins a comment."""
    found: dict[Pair, float] = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise LocalError(f"{path}: {error}") from None
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            one, other, distance = words
            found[one, other] = float(distance)
        except ValueError:
            raise LocalError(f"{path}:{number}: expected two addresses and a distance in m, got {line!r}") from None
    return found


def _measure(
    args: argparse.Namespace,
    anchors: Sequence[str],
    lines: Sequence[ModuleConnection],
    calibrate: survey.Calibrate,
    wait: Callable[[float], None],
) -> dict[Pair, float]:
    seconds = args.seconds or survey.SECONDS
    if len(lines) > 1 and args.port:
        infos = {configure.inspect(line).address: line for line in lines}
        told = survey.surveyed({name: line.ask(LOC_GET).ranges for name, line in infos.items()}, calibrate)
        if told:
            _say("distances of the phone app's auto-positioning are there: they are used")
            return told
        return survey.take_turns(lines, seconds, calibrate, wait, _say)
    if len(lines) != 1:
        raise LocalError(
            "which robot's tag is carried? say --robots NAME, or give the anchors' ports: --port A --port B"
        )
    if len(anchors) < 3:
        raise LocalError("list the anchors' addresses in swarm.toml first (their places may be rough)")
    return survey.beside(lines[0], anchors, seconds, calibrate, wait, _ask)


def _text(layout: Layout, heights: dict[str, float]) -> str:
    lines = [f"# {len(layout.residuals)} distances, {layout.rms * 100:.1f} cm rms"]
    for (one, other), residual in sorted(layout.residuals.items(), key=lambda entry: -abs(entry[1]))[:3]:
        lines.append(f"# {one} {other}: {residual * 100:+.1f} cm")
    if not layout.redundant:
        lines.append("# so few distances fit exactly, whatever their errors: check one with a ruler")
    for name, place in layout.places.items():
        x, y = (round(value, 3) + 0.0 for value in place)  # no -0.000
        lines += ["[[anchors]]", f'address = "{name}"', f"x = {x:.3f}", f"y = {y:.3f}"]
        lines += [f"z = {heights[name]:.3f}"] if heights.get(name) else []
    return "\n".join(lines) + "\n"


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")


def _ask(text: str) -> None:
    _say(f"{text}, then press Enter")
    if not sys.stdin.readline():
        raise LocalError("the input ended: --auto with one tag asks for each anchor")
