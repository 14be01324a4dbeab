"""`swarm sim --virtual --view`: a run under virtual time on the page of `swarm view`, while it runs and after."""

import asyncio
import sys
from collections.abc import Callable

from laptop.cli.runs.view import announce
from laptop.view.feeds.virtual_feed import VirtualFeed
from sim.report import RunOutcome
from sim.scenario.options import Options
from sim.scenario.scenario import Scenario
from sim.virtual.run import VirtualRun
from swarm.errors import MissingPackageError


def watched(run: VirtualRun, plan: Scenario, options: Options, tell: Callable[[RunOutcome], int]) -> int:
    """Run, and serve the page until interrupted. `tell(outcome)` reports the end of the run, and returns its code."""
    try:
        from laptop.view import server
    except ModuleNotFoundError as error:
        raise MissingPackageError("--view", str(error.name), "lab") from None
    feed = VirtualFeed(run.world, plan.config, 1.0 if options.speed is None else options.speed)

    async def main() -> int:
        ended = asyncio.Event()
        server.end_on_signals(ended)
        codes: list[int] = []

        def go() -> RunOutcome:
            outcome = run.go()
            feed.ended()
            return outcome

        async def simulate() -> None:
            try:
                outcome = await asyncio.to_thread(go)
            except BaseException:
                ended.set()
                raise
            codes.append(tell(outcome))
            if not ended.is_set():
                sys.stderr.write("the page shows the end of the run, until Ctrl-C\n")
            sys.stdout.flush()

        running: list[asyncio.Task[None]] = []

        async def ready(address: str) -> None:
            announce(address, browse=not options.no_open)
            running.append(asyncio.create_task(simulate()))

        try:
            await server.serve(feed, None, 0, ready, ended)
        finally:
            feed.close()
            await asyncio.gather(*running)
        return codes[0]

    return asyncio.run(main())
