"""Inside a machine: who has the address of a robot, but not the key."""

from conftest import Processes
from inside_swarm import MESH, Swarm

from lab.radio.remote import Radio
from swarm.messages import LinkState, read


def test_a_robot_with_another_key_is_refused(radio: Radio, processes: Processes) -> None:
    """Though it has the address of a robot of the swarm."""
    swarm = Swarm(processes, "swarm")
    links: dict[str, LinkState] = {}

    def note(key: str, payload: bytes) -> None:
        links.update({each.peer: each for each in read(key, payload).links})

    swarm.buses["r1"].subscribe("swarm/r1/mesh/links", note)
    swarm.start(MESH, "r0")
    swarm.start(MESH, "r1")
    swarm.start(MESH, "r2", config="stranger")
    swarm.wait("r1's link to r0 is up", lambda: "r0" in links and links["r0"].state == "up", lambda: links)
    swarm.wait("r1 names the key of r2", lambda: "r2" in links and "key" in links["r2"].reason, lambda: links)
    counters: dict[str, int] = {}

    def refused() -> bool:
        counters.update(swarm.ask("r1", "status").counters)
        return counters.get("refused_key", 0) >= 1

    swarm.wait("r1 counts the refusal", refused, lambda: counters)
    assert links["r2"].connection == 0
    assert links["r0"].state == "up"
    swarm.end()
    swarm.close()
