"""What a host remembers is of the robots of its configuration: names that anybody may invent fill no memory."""

from memory_swarm import config_of

from services.apps import loader
from services.apps.host.host import LockstepHost, Part
from services.apps.host.topology import CONFIGURED, RunPlace
from services.apps.runner import Runner
from sim.virtual.apps.storage import MemoryStorage
from sim.virtual.bus import VirtualBus, VirtualRouter
from sim.virtual.events import EventQueue
from sim.virtual.runtime import VirtualRuntime
from swarm.app.run_options import RunOptions
from swarm.core.lockstep.frames import Channel
from swarm.messages import Links, LinkState

RUN = 7


def host_of_r0() -> LockstepHost:
    """A host of a run of two robots that drops those that are absent."""
    config, app, time = config_of(2), loader.load("consensus"), EventQueue()
    runtime = VirtualRuntime("r0", time, VirtualBus(VirtualRouter(time)))
    parts = [Part("", Runner(app.make(config, "r0"), app.source))]
    place = RunPlace.of(RUN, app.digest, RunOptions(drop=True), config, CONFIGURED, 1)
    host = LockstepHost(runtime, "consensus", parts, place, MemoryStorage(), None)
    host.start()
    return host


def test_frames_and_notes_of_robots_that_are_not_in_the_configuration_are_refused_and_forgotten() -> None:
    host = host_of_r0()
    driver = host.drivers[""]
    schema = driver.run.terms.schema
    texts = (
        Channel(RUN, 0, 1, schema).text,
        Channel(RUN, 5, 1, schema).text,
        Channel(RUN + 1, 0, 1, schema).text,
        Channel(RUN, 0, 1, schema ^ 1).text,
        driver.run.terms.notes,
    )
    for name in ("r1", *(f"x{number}" for number in range(100))):
        for text in texts:
            host._on_sync(f"swarm/{name}/app/consensus/sync/{text}", b"\1")
    assert driver.run._heard.keys() == {"r1"}
    assert driver.watch._strangers.keys() == {"r1"}
    assert host._runtime.counters["refused_keys"] == 100 * len(texts)


def test_links_with_robots_that_are_not_in_the_configuration_are_not_remembered() -> None:
    host = host_of_r0()
    for number in range(100):
        links = tuple(LinkState(name, "up", number, None, 0, 0, "") for name in ("r1", f"x{number}"))
        host._on_links(Links(0.0, links))
    assert host._connections == {"r1": 99}
