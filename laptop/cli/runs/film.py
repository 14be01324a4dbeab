"""`swarm film RUN FILE.mp4`: a recorded run as a film."""

import argparse
import asyncio
import re
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from swarm.errors import LocalError, MissingPackageError
from swarm.onboard.command_line import UNIX_MODULES
from swarm.process.arguments import add_json, number, show
from swarm.process.terminal import bar

if TYPE_CHECKING:
    from laptop.view.film import Film
    from laptop.view.recording import ViewedRecording

HELP = "make a film of a recorded run"

SIZES = (160, 4096)
FPS = (1.0, 120.0)
SPEED = (0.001, 1000.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RUN", help="folder or file of a recorded run")
    parser.add_argument(
        "film",
        type=Path,
        metavar="FILE",
        help=".mp4 or .webp (an animated picture for a page of text); replaced if it is there",
    )
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="pixels, even numbers (1280x720)")
    parser.add_argument("--fps", type=number(*FPS), default=30.0, metavar="N", help="pictures a second (30)")
    parser.add_argument(
        "--speed", type=number(*SPEED), default=1.0, metavar="X", help="how many times faster than the run (1)"
    )
    parser.add_argument(
        "--from",
        type=number(),
        dest="begin",
        metavar="S",
        help="start of the film, in seconds of the recording (its start)",
    )
    parser.add_argument(
        "--to", type=number(), dest="end", metavar="S", help="end of the film, in seconds of the recording (its end)"
    )
    parser.add_argument("--dark", action="store_true", help="use dark colours")
    add_json(parser)
    parser.add_argument(
        "--chart",
        action="append",
        default=[],
        metavar="TOPIC:FIELD",
        help="add a chart, e.g. app/consensus/state:state.value; may be repeated",
    )


def run(args: argparse.Namespace) -> int:
    """Make the film and return 0."""
    try:
        from laptop.view import chromium, film, server
    except ModuleNotFoundError as error:
        if error.name in UNIX_MODULES:
            raise
        raise MissingPackageError("swarm film", str(error.name), "lab") from None
    from laptop.view.recording import ViewedRecording

    # What is missing is said before the recording is read, which may take a while.
    film.encoder()
    chromium.browser()
    if args.film.suffix not in film.FORMATS:
        raise LocalError(f"{args.film}: expected a name that ends in {' or '.join(film.FORMATS)}")
    if not args.film.absolute().parent.is_dir():
        raise LocalError(f"{args.film.absolute().parent}: no such folder")
    feed = ViewedRecording(args.recording)
    for damage in feed.damage:
        sys.stderr.write(f"swarm: {damage}\n")
    plan = _plan(args, feed)

    async def main() -> None:
        ended = asyncio.Event()
        task = asyncio.current_task()
        assert task is not None
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)

        async def ready(address: str) -> None:
            await film.shoot(address, plan, args.film.absolute(), _bar)
            ended.set()

        await server.serve(feed, None, 0, ready, ended)

    try:
        asyncio.run(main())
    except asyncio.CancelledError:
        return 143
    show(args, {"film": str(args.film), "damage": list(feed.damage)}, [str(args.film)])
    return 0


def _plan(args: argparse.Namespace, feed: "ViewedRecording") -> "Film":
    """Return the film that the arguments describe. Raises `LocalError` where there can be no such film."""
    from laptop.view.film import Film

    size = re.fullmatch(r"(\d{1,5})x(\d{1,5})", args.size)
    width, height = (int(size[1]), int(size[2])) if size else (0, 0)
    if width % 2 or height % 2 or not SIZES[0] <= min(width, height) <= max(width, height) <= SIZES[1]:
        raise LocalError(f"--size {args.size}: expected WxH, both even and {SIZES[0]} to {SIZES[1]}")
    begin = feed.first if args.begin is None else max(feed.first, args.begin)
    end = feed.last if args.end is None else min(feed.last, args.end)
    if not begin < end:
        raise LocalError(
            f"--from and --to: nothing between them, the recording is from {feed.first:g} to {feed.last:g} s"
        )
    feed.check_charts(args.chart)
    theme = "dark" if args.dark else "light"
    return Film(begin, end, (width, height), args.fps, args.speed, tuple(args.chart), theme)


def _bar(done: int, count: int) -> None:
    """Draw a bar that grows on a terminal; elsewhere print a line for each tenth."""
    bar(sys.stderr, done, count)
    if sys.stderr.isatty():
        sys.stderr.write("\n" * (done == count))
    elif 10 * done // count != 10 * (done - 1) // count:
        sys.stderr.write(f"{done}/{count} pictures\n")
