"""`swarm foxglove`: show a running swarm, simulated or real, in Foxglove."""

import argparse
import signal
import time

from laptop.view import live
from swarm.process.arguments import whole

HELP = "serve the running swarm to Foxglove"
PORT = 8765
"""The port that Foxglove proposes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    live.add_arguments(parser)
    parser.add_argument(
        "--port", type=whole(0, 65535), default=PORT, metavar="N", help=f"port on 127.0.0.1 ({PORT}); 0 = any free port"
    )
    parser.add_argument("--control", action="store_true", help="let Foxglove set parameters of apps")


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted, or until a simulation ends."""
    from laptop.foxglove.server import FoxgloveServer

    feed, control = live.open_feed(args)
    try:
        server = FoxgloveServer(feed, control, args.port, writable=args.control)
        try:
            print(
                f"ws://127.0.0.1:{server.port}\n"
                "open it in Foxglove: Open connection, Foxglove WebSocket; end with Ctrl-C",
                flush=True,
            )
            signal.signal(signal.SIGTERM, signal.default_int_handler)
            while feed.kind == "robots" or feed.live:
                time.sleep(0.5)  # the signal ends the loop
        finally:
            server.close()
    finally:
        control.close()
        feed.close()
    return 0
