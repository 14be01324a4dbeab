"""Inside a machine: six robots' processes over RFCOMM compute bit for bit what the simulation computed on the host."""

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Processes
from inside_radio import SUPERVISION, adapters, bring_up, hci
from inside_swarm import APPS, MESH, NAMES, SHARE, Swarm

from lab.radio.remote import Radio
from lab.shapes import ENDLESS, ITERATIONS, LONG, SHAPES
from lab.waiting import run, until
from swarm.messages import read
from swarm.recording.run import Run

LINK_ENDS_S = 6.0
"""Seconds of silence until a link ends as the mesh sets it: two thirds of `dead` (`lab.shapes.TIMES`)."""


@pytest.fixture
def swarm(processes: Processes, request: pytest.FixtureRequest) -> Iterator[Swarm]:
    made = Swarm(processes, getattr(request, "param", "line"))
    yield made
    made.close()


def finish(swarm: Swarm, iterations: int) -> None:
    swarm.wait_reached("the end of the run", iterations)
    swarm.end()


def compare(swarm: Swarm, iterations: int) -> None:
    """State and result of each iteration, as text that is equal where the bits are."""
    run = Run(swarm.records)
    found = {robot: each.rows for robot, each in run.trajectories("consensus").items()}
    simulated = Run(SHARE / "simulated" / swarm.config).trajectories("consensus")
    assert set(found) == set(NAMES)
    for name in NAMES:
        for k in range(iterations + 1):
            assert found[name][k] == simulated[name].rows[k], f"{name}, iteration {k}"
    assert not [note for note in run.damage if "differ" in note]


@pytest.mark.parametrize("swarm", SHAPES, indirect=True)
def test_trajectories_are_those_of_the_simulation(swarm: Swarm, radio: Radio) -> None:
    swarm.run(ITERATIONS)
    finish(swarm, ITERATIONS)
    compare(swarm, ITERATIONS)
    links = {tuple(pair) for pair in radio.order("look")["links"]}
    assert links <= {(radio.addresses[i], radio.addresses[j]) for i, j in SHAPES[swarm.config]}


def told_by_radio(swarm: Swarm, name: str) -> list[dict[str, object]]:
    """What `swarm mesh --radio` says on that robot; all its links must be up, and nobody away."""
    own = {"ROBOT": name, "RUNTIME": swarm.processes.runtime / name, "CONFIG": SHARE / f"{swarm.config}.toml"}
    environment = [f"SWARM_{key}={value}" for key, value in own.items()]
    program = Path(sys.executable).with_name("swarm")
    said = run("swarm mesh --radio", ["env", *environment, str(program), "mesh", "--radio", "--json"])
    found: list[dict[str, object]] = json.loads(said)["radio"]
    return found


@pytest.mark.parametrize("swarm", ["star", "auto"], indirect=True)
def test_a_hub_carries_what_neighbours_tell_each_other(swarm: Swarm, radio: Radio) -> None:
    """It calls all others and is central of one piconet with them, as each mesh tells of its own end, and as each
    adapter tells, with the strength of the signal."""
    until("no connection of a test before", lambda: not radio.order("look")["links"])
    told: dict[tuple[str, str], tuple[str, str, str]] = {}

    def take(key: str, payload: bytes) -> None:
        for link in read(key, payload).links:
            told[key.split("/")[1], link.peer] = link.state, link.role, link.wanted_role

    for name, bus in swarm.buses.items():
        bus.subscribe(f"swarm/{name}/mesh/links", take)
    swarm.run(ITERATIONS)
    hub, *others = NAMES
    wanted = {(hub, name): ("up", "central", "central") for name in others}
    wanted |= {(name, hub): ("up", "peripheral", "peripheral") for name in others}
    swarm.wait("roles are those wanted", lambda: told == wanted, lambda: told)
    radio.order("change", rssi=-60)
    told_all = {"rssi": -60, "quality": 255, "failed": 0}
    for robot, peers, role in ((hub, others, "central"), (others[-1], [hub], "peripheral")):
        readings = [{"robot": robot, "peer": peer, "role": role, **told_all} for peer in peers]
        assert told_by_radio(swarm, robot) == readings
    finish(swarm, ITERATIONS)
    compare(swarm, ITERATIONS)
    first, *rest = radio.addresses
    assert {tuple(pair) for pair in radio.order("look")["links"]} <= {(first, each) for each in rest}


def test_faults_in_mid_run_change_no_bit(swarm: Swarm, radio: Radio) -> None:
    """What was sent into a cut, or to a mesh that was killed, is neither lost nor counted twice."""
    swarm.run(LONG)
    last = time.monotonic()

    def more(what: str, count: int = 4) -> None:
        """It goes on: everybody gets that much farther, and there is still something to break."""
        nonlocal last
        before = max(swarm.reached.values())
        swarm.wait_reached(f"after {what}", before + count)
        now = time.monotonic()
        sys.stdout.write(f"\n{what}: iteration {min(swarm.reached.values())} after {now - last:.1f} s ")
        last = now
        assert max(swarm.reached.values()) < LONG

    more("the start")
    first, second = radio.addresses[:2]
    radio.order("cut", one=first, other=second)
    time.sleep(SUPERVISION / 2)
    radio.order("mend", one=first, other=second)
    more("a short cut")
    radio.order("cut", one=first, other=second)
    time.sleep(SUPERVISION + 2)
    radio.order("mend", one=first, other=second)
    more("a cut longer than the supervision time")
    radio.order("drop", one=radio.addresses[2], other=radio.addresses[3])
    more("a link lost")
    hci(adapters()[radio.addresses[1]], "down")
    bring_up(radio)
    more("an adapter switched off and on")
    radio.order("unplug", address=radio.addresses[4])
    radio.order("plug", address=radio.addresses[4])
    bring_up(radio)
    more("an adapter unplugged and plugged")
    killed = swarm.kill(MESH, "r2")
    swarm.wait("another mesh runs", lambda: swarm.process(MESH, "r2") != killed)
    more("a mesh killed")
    killed = swarm.kill(APPS, "r3")
    swarm.wait("another app runs", lambda: swarm.process(APPS, "r3") != killed)
    more("an app killed")
    finish(swarm, LONG)
    compare(swarm, LONG)
    assert radio.order("look")["counts"]["lost"] >= 4


@pytest.mark.parametrize("swarm", ["around"], indirect=True)
def test_a_loop_goes_on_around_a_silent_link(swarm: Swarm, radio: Radio) -> None:
    """The other five links carry what one does not: through a cut that it outlives, and one that ends it."""
    radio.order("change", supervision=2 * LINK_ENDS_S)  # so that a link ends as the mesh sets it
    swarm.run(ENDLESS)

    def iterations(seconds: float) -> int:
        """How many all robots have done in that time."""
        before = min(swarm.reached.values())
        time.sleep(seconds)
        return min(swarm.reached.values()) - before

    def sent_around() -> int:
        """Frames of the two ends that have gone around the link between them."""
        return sum(swarm.ask(name, "status").counters.get("unicast_avoiding", 0) for name in NAMES[:2])

    def link_carries() -> bool:
        """All links are up, without which a loop has no other way, and ten iterations go without that way."""
        if any(link.state != "up" for told in swarm.links.values() for link in told.links):
            return False
        sent, before = sent_around(), max(swarm.reached.values())
        swarm.wait_reached("ten more", before + 10)
        return sent_around() == sent

    def lost() -> int:
        return int(radio.order("look")["counts"].get("lost", 0))

    swarm.wait("the link carries at the start", link_carries)
    whole = iterations(1.0)
    ends = {"one": radio.addresses[0], "other": radio.addresses[1]}

    # Robots go around a cut after a few round trips, which on a busy host is within seconds. How many iterations that
    # makes while the link lives is another matter: what waits for it takes the buffers that all links of a controller
    # share.
    before, sent, began = lost(), sent_around(), time.monotonic()
    radio.order("cut", **ends)
    swarm.wait("frames go around the cut", lambda: sent_around() > sent)
    radio.order("mend", **ends)
    sys.stdout.write(f"\nframes go around a cut after {time.monotonic() - began:.1f} s; {whole} iterations a second ")
    assert lost() == before or time.monotonic() - began >= LINK_ENDS_S
    swarm.wait("the link carries again", link_carries)
    before, sent = lost(), sent_around()
    radio.order("cut", **ends)
    swarm.wait("the silent link has ended", lambda: lost() > before)
    swarm.wait_reached("around the link that has ended", max(swarm.reached.values()) + 10)
    swarm.wait("a tenth of the pace", lambda: iterations(1.0) >= whole / 10)
    assert sent_around() > sent
    radio.order("mend", **ends)
    swarm.wait("the link carries again", link_carries)
    reached = min(swarm.reached.values())
    swarm.end()
    compare(swarm, reached)
