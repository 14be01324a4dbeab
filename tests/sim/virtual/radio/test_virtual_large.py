"""Large messages over virtual links of Bluetooth's bandwidth, by the shell of the mesh: pace and share of the links."""

import pytest

from bench.radio.swarm import overlays_of
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun

BANDWIDTH = 78_000.0
SIZE = 300_000
BEGINS = 6.0


@pytest.mark.parametrize("app", ["consensus", "led_sync"])
def test_a_large_message_over_three_hops_uses_the_links_and_lockstep_goes_on(app: str) -> None:
    arguments = [app, "--robots", "4", "--topology", "line", "--latency", "30ms", "--bandwidth", "78kB"]
    options = parse([*arguments, "--virtual", "--seconds", "14"])
    run = VirtualRun(options, build(options, PLACE))
    time = run.world.time
    r0, r3 = (overlays_of(run, name) for name in ("r0", "r3"))
    arrived: list[tuple[float, bytes]] = []
    r3.on_message(lambda sender, data: arrived.append((time.now, data)))
    payload = bytes(range(250)) * (SIZE // 250)
    iterations: list[float] = []
    advanced = run.advanced

    def note(*arguments: object) -> None:
        iterations.append(time.now)
        advanced(*arguments)  # type: ignore[arg-type]

    run.advanced = note  # type: ignore[method-assign]
    time.at(BEGINS, lambda: r0.send("r3", payload, timeout=60.0))
    run.go()
    ((ended, data),) = arrived
    assert data == payload
    assert SIZE / (ended - BEGINS) >= 0.8 * BANDWIDTH
    seconds = ended - BEGINS
    before = sum(BEGINS - seconds <= moment < BEGINS for moment in iterations)
    beside = sum(BEGINS <= moment < ended for moment in iterations)
    assert beside >= 0.85 * before
