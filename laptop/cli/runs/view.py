"""`swarm view`: see a swarm in the browser: a running simulation, real robots through ssh, or a recorded run."""

import argparse
import asyncio
import sys
import webbrowser
from functools import partial
from pathlib import Path

from laptop.view import live
from swarm.errors import LocalError, MissingPackageError
from swarm.process.arguments import number, picture, whole

HELP = "show the running swarm, or a recorded run, in the browser"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", nargs="?", type=Path, metavar="RUN", help="show a recorded run in place of a running swarm"
    )
    live.add_arguments(parser)
    parser.add_argument(
        "--port", type=whole(0, 65535), default=0, metavar="N", help="port on 127.0.0.1 (default: any free port)"
    )
    parser.add_argument(
        "--control", action="store_true", help="allow commands from the page: stop, cut links, press buttons ..."
    )
    text = "write a picture of the page, and end"
    parser.add_argument("--screenshot", type=partial(picture, endings=(".png",)), metavar="FILE.png", help=text)
    parser.add_argument("--at", type=number(), metavar="S", help="second of the recording for the picture (its end)")
    parser.add_argument(
        "--chart",
        action="append",
        default=[],
        metavar="TOPIC:FIELD",
        help="add a chart to the picture, e.g. app/consensus/state:state.value; may be repeated",
    )
    parser.add_argument("--no-open", action="store_true", help="only print the address")


def announce(address: str, *, browse: bool) -> None:
    """Tell the user where the page is, and open it."""
    print(f"{address}\nend with Ctrl-C", flush=True)
    if browse:
        webbrowser.open(address)


def run(args: argparse.Namespace) -> int:
    """Serve the page until interrupted."""
    try:
        from laptop.view import server
    except ModuleNotFoundError as error:
        raise MissingPackageError("swarm view", str(error.name), "lab") from None
    from laptop.view.feeds.feed import SimulationFeed
    from laptop.view.feeds.robots import Robots
    from laptop.view.recording import ViewedRecording

    feed: SimulationFeed | Robots | ViewedRecording
    control = None
    if args.recording and (args.robots or args.run_dir or args.real or args.config or args.ssh_config):
        raise LocalError("a recording has all of its robots: leave it out to look at a running swarm")
    if (args.at is not None or args.chart) and args.screenshot is None:
        raise LocalError("--at and --chart are for --screenshot")
    if args.at is not None and args.recording is None:
        raise LocalError("--at is for a recording: a running swarm is shown as it is now")
    if args.recording is not None:
        if args.control:
            raise LocalError("--control: there is nothing to control in a recording")
        feed = ViewedRecording(args.recording)
        for damage in feed.damage:
            print(f"swarm: {damage}", file=sys.stderr)
        feed.check_charts(args.chart)
    else:
        feed, control = live.open_feed(args)

    at = None
    if isinstance(feed, ViewedRecording):
        at = feed.last if args.at is None else min(max(args.at, feed.first), feed.last)

    async def main() -> None:
        ended = asyncio.Event()

        async def ready(address: str) -> None:
            if args.screenshot is not None:
                from laptop.view import page_picture  # drives Chromium, over pipes that only Unix has

                await page_picture.take(address, args.screenshot, at, args.chart)
                print(args.screenshot)
                ended.set()
                return
            announce(address, browse=not args.no_open)

        server.end_on_signals(ended)
        await server.serve(feed, control, args.port, ready, ended)

    try:
        asyncio.run(main())
    finally:
        if control is not None:
            control.close()
        if not isinstance(feed, ViewedRecording):
            feed.close()
    return 0
