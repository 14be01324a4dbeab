"""`links = auto`: which robot is the hub follows from measured round trips, by rule, on the wire and on the slot
radio."""

from collections import Counter
from functools import partial
from itertools import pairwise
from random import Random
from types import SimpleNamespace

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.actions import Actions
from services.mesh.core.calling import Calling
from services.mesh.core.link.calls import Caller, Local
from services.mesh.core.link.session import Session
from services.mesh.core.routing import hub_choice
from services.mesh.core.routing.hub_choice import (
    EVERY,
    PAYS,
    REST,
    SLOW,
    HubChoice,
    Reached,
    candidate,
    is_slow,
    verdict,
)
from services.mesh.core.routing.physical_links import follow
from services.mesh.core.routing.topology import Ground, Hub, TopologyVersion
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun
from swarm.config.types import TREE
from swarm.core.graph import Graph
from swarm.errors import FrameError
from swarm.messages import Stop

SIX = [f"r{place}" for place in range(6)]
HOUR = 3600.0

# -- the rule ----------------------------------------------------------------------------------------------------------


@given(st.builds(Hub, st.integers(0, 7), st.integers(0, 7), st.integers(0, 65535), st.just(True)), st.floats(0, 100))
def test_a_tried_hub_stays_only_where_it_is_measured_to_pay(hub, mean):
    after = verdict(hub, mean)
    assert not after.trial
    if PAYS * mean * 1e3 <= hub.round_trip:
        assert after == hub._replace(trial=False)
    else:
        assert (after.place, after.before) == (hub.before, hub.place)


def test_a_hub_is_slow_in_a_poor_place_with_a_weak_link_or_where_it_hears_too_few():
    good, bridged = [Reached(0.04, 1, 1)] * 5, [Reached(0.04, 1, 1)] * 4 + [Reached(0.04, 2, 1)]
    assert not is_slow(good, 0.055, 0.04)
    assert is_slow(good, 0.065, 0.04)
    assert is_slow(good, SLOW + 0.001, SLOW)
    assert is_slow(bridged, 0.04, 0.04)


def test_a_robot_that_stands_in_for_the_hub_is_tried_first_and_then_who_has_the_fastest_link():
    reached = {1: Reached(0.05, 1, 1), 2: Reached(0.03, 1, 1), 3: Reached(0.09, 1, 2), 4: Reached(0.2, 2, 1)}
    order = []
    while (place := candidate(reached, order)) is not None:
        order.append(place)
    assert order == [3, 2, 1, 4]


class Swarm:
    """Robots of which each one has, as the hub, mean round trips around a number of its own, and hears some."""

    def __init__(self, means, deaf, noise):
        """`deaf[place]`: robots that this one does not hear as the hub."""
        self.means, self.deaf, self.noise = means, deaf, noise
        self.hub = Hub()
        self.choices = [HubChoice(place) for place in range(len(means))]
        for choice in self.choices:
            choice.begin(0.0)
        self.changes = []
        self.now = 0.0

    def reached(self, hub):
        bridged = self.deaf[hub]
        return {
            place: Reached(self.means[hub] * next(self.noise), 1 + (place in bridged), 1 + (bool(bridged)))
            for place in range(len(self.means))
            if place != hub
        }

    def run(self, seconds):
        end = self.now + seconds
        while self.now < end:
            self.now += EVERY
            choice = self.choices[self.hub.place]
            after = choice.look(self.hub, self.reached(self.hub.place), self.now)
            if after != self.hub:
                self.changes.append((self.now, self.hub, after))
                self.hub = after
                for each in self.choices:
                    each.adopted(after, range(len(self.means)), self.now)


@costly(30)
@given(
    data=st.data(),
    means=st.lists(st.sampled_from([0.04, 0.06, 0.08, 0.15, 0.3, 1.0]), min_size=2, max_size=5),
    seed=st.integers(0, 99),
)
def test_whatever_hubs_are_worth_trials_are_rare_and_the_hub_never_gets_worse(data, means, seed):
    random = Random(seed)
    deaf = [data.draw(st.sets(st.integers(0, len(means) - 1), max_size=1)) - {place} for place in range(len(means))]
    swarm = Swarm(means, deaf, iter(lambda: random.uniform(0.9, 1.1), None))
    swarm.run(16 * HOUR)
    trials = [at for at, _, after in swarm.changes if after.trial]
    assert all(after - before >= REST for before, after in pairwise(trials))
    # A trial ends by one more change at most.
    assert len(swarm.changes) <= 2 * len(trials)
    settled = swarm.hub.before if swarm.hub.trial else swarm.hub.place
    assert settled == 0 or means[settled] * PAYS <= 1.3 * means[0]
    if means[0] < SLOW / 1.1 and not deaf[0]:
        assert swarm.changes == []
    if means[settled] > SLOW * 1.1:  # then all others have had their turn
        assert all(mean * PAYS * 1.3 > means[settled] for mean in means)


def test_trials_in_vain_become_twice_as_rare_each_time():
    swarm = Swarm([0.2, 0.2, 0.2], [set(), set(), set()], iter(lambda: 1.0, None))
    swarm.run(48 * HOUR)
    trials = [at for at, _, after in swarm.changes if after.trial]
    gaps = [after - before for before, after in pairwise(trials)]
    assert gaps[0] < 2 * REST
    assert gaps[3] > 7 * REST
    assert max(gaps) < hub_choice.LONGEST_REST + 300
    assert swarm.hub.place == 0 or swarm.hub.trial


def test_a_trial_that_loses_a_robot_or_is_slower_ends_sooner():
    hub = Hub(1, 0, 200, trial=True)
    for robots, mean, ends_at in ((1, 0.03, hub_choice.LOST), (3, 0.5, hub_choice.MEASURED), (3, 0.1, 60.0)):
        choice = HubChoice(1)
        choice.adopted(hub, (0, 2, 3), 100.0)
        now, after = 100.0, hub
        while after == hub:
            now = choice.next_deadline()
            after = choice.look(hub, {place: Reached(mean, 1, 1) for place in (0, 2, 3)[:robots]}, now)
        assert now == 100.0 + ends_at
        assert after.place == (0 if ends_at < 60 else 1)


def test_a_hub_that_starts_in_its_trial_measures_for_the_whole_of_it():
    hub, choice = Hub(1, 0, 200, trial=True), HubChoice(1)
    choice.begin(1000.0)
    assert choice.look(hub, {0: Reached(9.0, 1, 1)}, 1000.0) == hub
    assert choice.next_deadline() == 1000.0 + EVERY


def test_a_trial_goes_on_while_the_hub_before_is_away():
    hub, choice = Hub(1, 0, 200, trial=True), HubChoice(1)
    choice.adopted(hub, (0, 2), 0.0)
    for now in range(0, 500, 5):
        assert choice.look(hub, {2: Reached(5.0, 1, 1)}, float(now)) == hub
    assert choice.look(hub, {0: Reached(5.0, 1, 1), 2: Reached(5.0, 1, 1)}, 500.0).place == 0


# -- the value ---------------------------------------------------------------------------------------------------------


hubs = st.builds(Hub, st.integers(0, 5), st.integers(0, 5), st.integers(0, 65535), st.booleans())


@given(hubs, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_a_choice_survives_wire_and_file_and_only_where_hubs_are_measured(hub, version, step):
    ground = Ground(SIX, Graph.of_shape("loop", SIX).edges, auto=False, links=TREE, measured=True)
    value = TopologyVersion(version, step, "r2", False, ground.first.edges, hub)
    if not version and hub == Hub():
        return
    assert ground.decode(ground.encode(value)) == value
    assert ground.from_file(ground.to_file(value)) == value
    fixed = Ground(SIX, ground.first.edges, auto=False, links=TREE)
    assert fixed.base == ground.base
    assert fixed.decode(ground.encode(value)) == (value if hub == Hub() else None)


def test_a_choice_has_these_bytes():
    ground = Ground(SIX[:3], (("r0", "r1"),), auto=False, links=TREE, measured=True)
    value = TopologyVersion(0, 1, "r0", False, ground.first.edges, Hub(2, 0, 194, trial=True))
    data = ground.encode(value)
    assert data[:2].hex(" ") == "06 06"
    assert data[14:].hex(" ") == "02 72 30 02 00 00 00 c2 00 01 01 00 00 00"
    assert ground.physical(value) == (("r2", "r0"), ("r2", "r1"))
    for bad in (data[:18], data[:1] + b"\x04" + data[2:], data[:17] + b"\x03" + data[18:]):
        with pytest.raises(FrameError):
            ground.decode(bad)


@given(st.permutations(SIX), st.sampled_from(SIX), st.dictionaries(st.sampled_from(SIX), st.booleans()))
def test_each_robot_calls_those_behind_it_in_the_order_of_hubs(order, me, dials):
    dials.pop(me, None)
    before = dict(dials)
    turned = follow(dials, order, me)
    assert dials == {peer: order.index(me) < order.index(peer) for peer in before}
    assert turned == {peer for peer in before if before[peer] != dials[peer]}


def test_of_two_robots_that_both_call_only_the_lower_ones_second_call_makes_a_link():
    """An accepted call that comes to nothing is forgotten: the next one is a knock again, which is answered."""
    linking = SimpleNamespace(hub=lambda: Hub(), knocked=lambda robot, now: None)
    local = partial(Local, network="lab", incarnation=1, insecure=True, robots=frozenset(("r0", "r1")), pages=True)
    of_low, of_high = local(robot="r0", dials={"r1": True}), local(robot="r1", dials={"r0": True})
    low, high = (Calling(each, linking, {}, Actions(), Random(0).random) for each in (of_low, of_high))
    assert [high.is_knock("r0", 0.0) for _ in range(3)] == [True, False, False]
    assert [low.is_knock("r1", 0.0) for _ in range(3)] == [True, True, True]
    inert = {"admit": lambda *channel: True, "clock": None, "counters": Counter()}
    high.begun(session := Session(of_high, bytes(16), 0.0, dialled=None, **inert), Caller("address", "r0"))
    high.failed(session, 1.0, refused=False)
    assert [high.is_knock("r0", 0.0) for _ in range(2)] == [True, False]


# -- whole swarms on the slot radio ------------------------------------------------------------------------------------


class AutoRun:
    """Consensus of six robots; the links and choices that they have."""

    def __init__(self, graph, *more, losses=(), cuts=()):
        options = parse(["consensus", "--virtual", "--radio", "slots", "--robots", "6", "--topology", graph, *more])
        self.run = VirtualRun(options, build(options, PLACE))
        self.world = self.run.world
        for a, b in cuts:
            self.world.air.cut(a, b, 1e6)
        self.world.air.radio.losses.update(dict(losses))
        self.moments = []
        self.hubs = [Hub()]
        self._advanced, self.run.advanced = self.run.advanced, self._note

    def _note(self, source, line):
        if source.robot == "r2":
            self.moments.append(self.world.time.now)
            if (hub := self.choice("r2")) != self.hubs[-1]:
                self.hubs.append(hub)
        self._advanced(source, line)

    def choice(self, name):
        return self.world.robots[name].mesh.look(lambda overlays, now: overlays.linking.value.hub)

    def pace(self, since, until):
        found = [moment for moment in self.moments if since <= moment < until]
        return (found[-1] - found[0]) / (len(found) - 1)

    def links(self):
        return {name: [link.peer for link in robot.mesh.links().links] for name, robot in self.world.robots.items()}


def star(hub):
    return {name: [other for other in SIX if other != hub] if name == hub else [hub] for name in SIX}


@pytest.mark.slow
def test_a_hub_that_does_not_hear_a_robot_hands_over_to_one_that_does(monkeypatch):
    for name, seconds in (("SUSTAINED", 15.0), ("TRIAL", 30.0), ("MEASURED", 15.0)):
        monkeypatch.setattr(hub_choice, name, seconds)
    swarm = AutoRun("thesis-d", "--seconds", "90", cuts=[("r0", "r5")])
    assert swarm.run.go().problems == ()
    assert [(hub.place > 0, hub.trial) for hub in swarm.hubs] == [(False, False), (True, True), (True, False)]
    assert {swarm.choice(name) for name in SIX} == {swarm.hubs[-1]}
    hub = SIX[swarm.hubs[-1].place]
    assert swarm.links() == star(hub)
    radio = swarm.world.air.radio
    assert {tuple(device.roles) for device in radio.devices.values()} == {(hub,)}  # one piconet
    roles = {
        link.role == link.wanted_role for robot in swarm.world.robots.values() for link in robot.mesh.links().links
    }
    assert roles == {True}
    assert swarm.pace(70, 90) < 0.06
    told = swarm.world.robots[hub].mesh.look(lambda overlays, now: overlays.topology(now)).hub
    assert (told.robot, told.before, told.trial) == (hub, "r0", False)
    assert told.round_trip * PAYS < told.round_trip_before


@pytest.mark.slow
def test_a_hub_with_a_bad_link_hands_over_and_no_bit_of_the_run_changes():
    losses = {frozenset(("r0", "r3")): 0.6}
    swarm = AutoRun("line", "--iterations", "2600", losses=losses.items())
    rows = {name: path.rows for name, path in swarm.run.go().trajectories.items()}
    assert [(hub.place > 0, hub.trial) for hub in swarm.hubs] == [(False, False), (True, True), (True, False)]
    plain = parse(["consensus", "--virtual", "--robots", "6", "--topology", "line", "--iterations", "2600"])
    assert rows == {name: path.rows for name, path in VirtualRun(plain, build(plain, PLACE)).go().trajectories.items()}


@pytest.mark.slow
def test_where_no_hub_is_better_the_first_one_is_the_hub_again():
    losses = {frozenset(("r3", name)): 0.6 for name in SIX if name != "r3"}
    swarm = AutoRun("line", "--seconds", "240", losses=losses.items())
    assert swarm.run.go().problems == ()
    assert [hub.trial for hub in swarm.hubs] == [False, True, False]
    assert swarm.choice("r0").place == 0
    assert swarm.links() == star("r0")


@pytest.mark.slow
def test_a_chosen_hub_that_is_switched_off_has_successors_and_is_the_hub_again():
    drop = ("--absent", "drop", "--drop-after", "3", "--off", "r1@150s,40s")
    swarm = AutoRun("thesis-d", "--seconds", "230", *drop, cuts=[("r0", "r5")])
    assert swarm.run.go().problems == ()
    gaps = [after - before for before, after in pairwise(swarm.moments) if before > 100]
    assert 2 < max(gaps) < 15
    assert swarm.links()["r1"] == star("r1")["r1"]


@pytest.mark.slow
def test_a_good_hub_stays():
    swarm = AutoRun("full", "--seconds", "100")
    assert swarm.run.go().problems == ()
    assert swarm.hubs == [Hub()]


@pytest.mark.parametrize(
    ("count", "older", "before", "after"),
    [
        pytest.param(4, "r0 r1", Hub(3, 2, 200, trial=True), Hub(2, 3, 200), id="both call"),
        pytest.param(4, "r0 r1", Hub(3, 1, 200), Hub(0, 3, 200, trial=True), id="each waits for a hub in the other"),
        pytest.param(6, "r5", Hub(5, 1, 200), Hub(0, 5, 200), id="an earlier hub was away"),
    ],
)
def test_parts_of_a_swarm_with_different_hubs_meet_agree_and_hear_each_others_stops(count, older, before, after):
    options = parse(["consensus", "--virtual", "--radio", "slots", "--robots", str(count), "--topology", "line",
                     "--iterations", "100000"])  # fmt: skip
    world = VirtualRun(options, build(options, PLACE)).world
    world.time.run(25.0)
    first = world.robots["r0"].mesh.look(lambda overlays, now: overlays.linking.value)
    ground = Ground(SIX[:count], first.edges, auto=False, links=TREE, measured=True)
    for name, robot in world.robots.items():
        for other in world.robots.keys() - set(older.split()) if name in older else ():
            world.air.cut(name, other, 60.0)
        step, hub = (1, before) if name in older else (2, after)
        data = ground.encode(first._replace(step=step, issuer=SIX[hub.before], hub=hub))
        robot.mesh.ask(lambda overlays, now, data=data: overlays.linking.receive("r0", data, now))
    world.time.run(85.0)
    world.robots["r0"].mesh.ask(lambda overlays, now: overlays.stop(Stop(now, "r0", "smoke"), now))
    world.time.run(240.0)
    values = {robot.mesh.look(lambda overlays, now: overlays.linking.value) for robot in world.robots.values()}
    assert len(values) == 1
    hub = SIX[values.pop().hub.place]
    links = {link.peer: link.state for link in world.robots[hub].mesh.links().links}
    assert links == dict.fromkeys(world.robots.keys() - {hub}, "up")
    assert {tuple(device.roles) for device in world.air.radio.devices.values()} == {(hub,)}  # one piconet
    for robot in world.robots.values():
        assert robot.mesh.look(lambda overlays, now: overlays.stopped(now)).by == {"r0": "smoke"}
