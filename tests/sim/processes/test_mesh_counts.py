"""The number of messages of a run of processes."""

from sim.processes import findings
from sim.processes.monitor import Seen
from swarm.messages import Status


def test_messages_of_a_mesh_that_was_started_again_count_too() -> None:
    seen = Seen()
    for pid, sent in ((1, 4), (1, 10), (2, 0), (2, 3), (3, 5)):
        seen.take_status(Status(1.0, "mesh", "ready", "", pid, 0.0, {"sent_sync": sent, "sent_bulk": 100}))
    seen.take_status(Status(1.0, "balancer", "ready", "", 4, 0.0, {}))
    silent = Seen()
    assert findings.messages({"r0": seen, "r1": silent}) == 10 + 3 + 5
    assert findings.messages({"r1": silent}) is None
