"""Commands that ask again until there is enough: an answer is no reason to ask at once."""

from collections.abc import Callable
from pathlib import Path

import pytest

from swarm.bus.zenoh_bus import Bus
from swarm.messages import AppEpoch, Topology
from swarm.messages.codec import encode
from swarm.onboard.buses.ask import ROUND, Answers

TOPOLOGY = Topology(0.0, 0, 0, "", False, 0.0, (), (), (), (), {})
EPOCH = AppEpoch(0.0, 0, 0, ("r0",), (), (), False, 0)


@pytest.mark.usefixtures("router")
@pytest.mark.parametrize(
    ("topic", "answer", "asking"),
    [
        ("mesh/topology", TOPOLOGY, lambda found: Answers(found, Topology, "mesh", "topology")),
        ("app/consensus/epoch", EPOCH, lambda found: Answers(found, AppEpoch, "app/consensus", "epoch")),
    ],
    ids=["topology", "epoch"],
)
def test_commands_that_wait_for_answers_ask_once_a_round(
    runtime: Path, topic: str, answer: object, asking: Callable
) -> None:
    asked = []

    def tell(*_: object) -> bytes:
        asked.append(topic)
        return encode(answer)

    with Bus.of(runtime) as robot, Bus.of(runtime) as here:
        robot.serve(f"swarm/r0/{topic}", tell)
        waiting = asking({"r0": here})
        waiting.wait(60.0, lambda: bool(asked))
        asked.clear()
        waiting.wait(1.5 * ROUND, lambda: False)
    assert len(asked) <= 3  # two rounds, and an answer to the last question before them
