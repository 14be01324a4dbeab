"""A run under virtual time that is watched: what the page gets of it, and how fast time passes."""

import asyncio
import math
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from conftest import wait_until

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
from aiohttp.test_utils import TestClient, TestServer

from bench.rigs.running import running
from laptop.view.feeds.virtual_feed import BEHIND_S, LAST_S, VirtualFeed
from laptop.view.server import application
from sim.report import RunOutcome
from sim.scenario import options as arguments
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun
from swarm.errors import ConfigError


@contextmanager
def watched(
    *words: str, speed: float = math.inf
) -> Iterator[tuple[VirtualFeed, VirtualRun, list[RunOutcome], threading.Thread]]:
    """A run with its watcher, not begun; what it ends with."""
    options = arguments.parse([*words, "--virtual"])
    plan = build(options, PLACE)
    run = VirtualRun(options, plan)
    live = VirtualFeed(run.world, plan.config, speed)
    outcomes: list[RunOutcome] = []

    def go() -> None:
        outcomes.append(run.go())
        live.ended()

    thread = threading.Thread(target=go)
    try:
        yield live, run, outcomes, thread
    finally:
        live.close()
        if thread.is_alive():
            thread.join()


def newest(live: VirtualFeed, robot: str, topic: str) -> dict[str, object]:
    with live.lock:
        return dict(live.picture.newest(robot, topic) or {})


def test_a_watched_virtual_run_shows_what_one_in_real_time_shows() -> None:
    with watched("consensus", "--robots", "3", "--iterations", "40") as (live, _, outcomes, thread):
        thread.start()
        thread.join()
        assert not live.live
        assert not outcomes[0].problems
        assert newest(live, "r1", "app/consensus/state")["k"] == 40
        assert newest(live, "r1", "app/consensus/progress")["phase"] == "done"
        assert {"x", "y", "heading"} <= newest(live, "r2", "sim/truth").keys()
        assert newest(live, "r2", "dwm/pose")["deviation_x"] > 0.0
        assert newest(live, "r0", "balancer/state")["mode"] == "balancing"
        assert [link["state"] for link in newest(live, "r1", "mesh/links")["links"]] == ["up", "up"]
        assert live.picture.hops()["r0>r1"] >= 40
        assert live.now() == pytest.approx(outcomes[0].seconds + outcomes[0].started_s + LAST_S, abs=0.1)


def test_a_watched_virtual_run_shows_what_apps_record() -> None:
    with watched("formation", "--robots", "3", "--seconds", "3") as (live, _, _, thread):
        thread.start()
        thread.join()
        assert newest(live, "r1", "app/formation/record/off")["values"]["value"] > 0  # type: ignore[index]


def test_the_values_of_an_app_are_those_of_an_unwatched_run() -> None:
    words = ("consensus", "--robots", "3", "--iterations", "40")
    options = arguments.parse([*words, "--virtual"])
    alone = VirtualRun(options, build(options, PLACE)).go()
    with watched(*words) as (_, _, outcomes, thread):
        thread.start()
        thread.join()
        assert outcomes[0].trajectories == alone.trajectories


def test_time_passes_as_the_page_wishes() -> None:
    with watched("consensus", "--robots", "2", "--seconds", "1000", speed=1.0) as (live, run, outcomes, thread):
        live.set_pace(1.0, True)
        thread.start()
        wait_until(lambda: live.pace()["paused"])
        assert live.now() < BEHIND_S
        live.set_pace(50.0, False)
        wait_until(lambda: live.now() > 1.0)
        live.set_pace(None, False)
        assert live.pace()["speed"] is None
        wait_until(lambda: live.pace()["actual"] > 1.0)
        live.set_pace(1.0, True)
        for wrong in (0.0, -1.0, math.nan, 1e9):
            with pytest.raises(ValueError, match="speed"):
                live.set_pace(wrong, False)
        # Closing ends a run that waits.
        live.close()
        thread.join()
        assert outcomes
        assert run.world.time.now < 1000.0


def test_a_page_may_pause_it_and_do_nothing_else() -> None:
    with watched("consensus", "--robots", "2", "--iterations", "5") as (live, _, _, _):

        async def main() -> None:
            async with TestClient(TestServer(application(live, None, "token"), host="127.0.0.1")) as client:
                socket = await client.ws_connect("/live?token=token")
                assert (await socket.receive_json(timeout=60))["pace"] == {
                    "speed": None, "actual": 0.0, "paused": False,
                }  # fmt: skip

                async def said(asked: object) -> object:
                    await socket.send_json(asked)
                    while True:
                        message = await socket.receive_json(timeout=60)
                        if "done" in message or "refused" in message:
                            return message

                assert await said({"pace": {"speed": 2, "paused": True}}) == {"done": "paused"}
                assert live.pace()["speed"] == 2.0
                assert await said({"pace": {"speed": None, "paused": False}}) == {"done": "speed: max"}
                for wrong in (
                    {"pace": {"speed": 0, "paused": False}},
                    {"pace": {}},
                    {"pace": 1},
                    {"do": {"act": "stop"}},
                ):
                    assert "refused" in await said(wrong)

        asyncio.run(main())


@pytest.mark.parametrize(
    "words", [("--view",), ("--virtual", "--speed", "2"), ("--virtual", "--view", "--speed", "0"), ("--no-open",)]
)
def test_what_does_not_go_together_is_refused(words: tuple[str, ...]) -> None:
    with pytest.raises((ConfigError, SystemExit)):
        arguments.parse(["consensus", *words])


def test_the_command_serves_until_it_is_interrupted_and_reports() -> None:
    command = [
        sys.executable,
        "-m",
        "laptop.cli.runs.sim",
        "consensus",
        "--virtual",
        "--robots",
        "2",
        "--iterations",
        "5",
    ]
    with running(
        [*command, "--view", "--no-open", "--speed", "max"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3],
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        assert "until Ctrl-C" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert "r1" in output
