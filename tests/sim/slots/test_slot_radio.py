"""The slot radio: every byte arrives in order or the link is lost, time never runs backwards, no link is faster than
its packets; one exchange and one page calculated by hand."""

import itertools
from dataclasses import replace
from random import Random

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from sim.slots.calls import ABSENT, BUSY, FULL, Calls
from sim.slots.parameters import EDR2, FRAME, MAX_PERIPHERALS, OVERHEAD, SLOT, THESIS, SlotParameters
from sim.slots.radio import SlotRadio
from sim.virtual.events import EventQueue
from swarm.errors import ConfigError

EXACT = replace(THESIS, loss=0.0, host=0.0, uart=1e30)
"""Nothing is drawn, and hosts take no time."""


class Swarm:
    """Robots with links, and what arrives where."""

    def __init__(self, links, parameters=EXACT, seed=1):
        self.time = EventQueue()
        names = sorted({name for link in links for name in link})
        self.radio = SlotRadio(self.time, names, parameters, Random(f"{seed} slots"))
        self.links = {link: self.radio.connect(*link) for link in links}
        self.heard, self.lost = [], []
        for link, there in self.links.items():
            there.lost = lambda link=link: self.lost.append((link, self.time.now))

    def send(self, link, sender, size, number=0):
        where = lambda: self.heard.append((self.time.now, link, sender, number))  # noqa: E731
        self.radio.send(self.links[link], sender, size, where)

    def run(self, seconds):
        self.time.run(seconds)


def test_an_exchange_takes_the_slots_calculated_by_hand():
    swarm = Swarm([("a", "b")])
    # At 10.1 ms the central has something: its next even slot begins at 11.25 ms, and 359 B take a packet of three.
    swarm.time.at(0.0101, swarm.send, ("a", "b"), "a", 350)
    # The peripheral's answer is in its controller meanwhile: it goes in the slot after those three, and takes five.
    swarm.time.at(0.0102, swarm.send, ("a", "b"), "b", 600)
    swarm.run(0.05)
    assert [at for at, *_ in swarm.heard] == pytest.approx([0.01125 + 3 * SLOT, 0.01125 + 8 * SLOT])
    assert [sender for _, _, sender, _ in swarm.heard] == ["a", "b"]


def test_a_peripheral_that_has_something_waits_for_the_poll():
    swarm = Swarm([("a", "b")])
    swarm.time.at(0.5, swarm.send, ("a", "b"), "b", 10)
    swarm.run(1.0)
    polled = [n * 40 * SLOT for n in range(60)]  # used at its start, so that it is polled every 40 slots for 1 s
    (at, *_), *_ = swarm.heard
    assert any(at == pytest.approx(poll + 4 * SLOT, abs=4 * SLOT) for poll in polled)
    assert 0.5 < at < 0.5 + 44 * SLOT


GRAPHS = st.sampled_from(
    [
        [("a", "b")],
        [("a", "b"), ("c", "b")],
        [("a", "b"), ("b", "c"), ("c", "a")],
        [("a", "b"), ("a", "c"), ("b", "c"), ("d", "a"), ("d", "b")],
    ]
)
FRAMES = st.lists(st.tuples(st.floats(0.0, 0.3), st.integers(0, 9), st.booleans(), st.integers(0, FRAME)), max_size=25)


def at_last(frames):
    return sum(gap for gap, *_ in frames)


def planned(swarm, graph, frames):
    """Plan to send these frames; by link and sender their number, time and size."""
    at, sent = 0.0, {}
    for number, (gap, which, down, size) in enumerate(frames):
        at += gap
        link = graph[which % len(graph)]
        sender = link[0] if down else link[1]
        swarm.time.at(at, swarm.send, link, sender, size, number)
        sent.setdefault((link, sender), []).append((number, at, size))
    return sent


@costly(60)
@given(GRAPHS, FRAMES, st.sampled_from((0.05, 0.3)), st.sampled_from((0.0, 0.05, 0.5)), st.integers(0, 9))
def test_every_frame_arrives_once_and_in_order_on_any_graph(graph, frames, stay, loss, seed):
    swarm = Swarm(graph, SlotParameters(stay=stay, loss=loss), seed)
    sent = planned(swarm, graph, frames)
    swarm.run(at_last(frames) + 60.0)
    assert not swarm.lost
    times = [time for time, *_ in swarm.heard]
    assert times == sorted(times)
    for way, numbers in sent.items():
        got = [(number, time) for time, link, sender, number in swarm.heard if (link, sender) == way]
        assert [number for number, _ in got] == [number for number, *_ in numbers]
        for (_, left, size), (_, came) in zip(numbers, got, strict=True):
            packets = -(-(size + OVERHEAD) // EDR2[-1][0])
            assert came >= left + packets * SLOT


@costly(20)
@given(GRAPHS, st.integers(0, 9))
def test_the_same_seed_gives_the_same_times(graph, seed):
    def times():
        swarm = Swarm(graph, SlotParameters(), seed)
        for number, link in enumerate(graph * 3):
            swarm.time.at(0.1 * number, swarm.send, link, link[number % 2], 100, number)
        swarm.run(5.0)
        return swarm.heard

    assert times() == times()


def test_a_saturated_link_carries_what_its_packets_hold_and_no_more():
    swarm = Swarm([("a", "b")])
    for number in range(400):
        swarm.send(("a", "b"), "a", EDR2[-1][0] - OVERHEAD, number)
    swarm.run(100.0)
    seconds = swarm.heard[-1][0] - swarm.heard[0][0]
    assert 399 * 679 / seconds == pytest.approx(679 / (6 * SLOT), rel=0.01)  # 181 kB/s, five slots and one back


def test_bridges_share_their_time_and_are_slower_than_one_piconet():
    def mean(graph):
        swarm = Swarm(graph, SlotParameters())
        sent = {}
        for number in range(200):
            sent[number] = 0.1 * number
            swarm.time.at(sent[number], swarm.send, ("a", "b"), "a", 100, number)
        swarm.run(30.0)
        return sum(at - sent[number] for at, _, _, number in swarm.heard) / 200

    alone, hub, bridge = mean([("a", "b")]), mean([("a", "b"), ("a", "c")]), mean([("a", "b"), ("c", "b")])
    assert hub < 1.5 * alone
    assert bridge > 3 * hub


@costly(60)
@given(GRAPHS, FRAMES, st.lists(st.tuples(st.floats(0.0, 5.0), st.integers(0, 9)), max_size=8), st.integers(0, 9))
def test_switches_of_roles_lose_and_reorder_nothing(graph, frames, switches, seed):
    swarm = Swarm(graph, SlotParameters(), seed)
    sent = planned(swarm, graph, frames)
    for time, which in switches:
        swarm.time.at(time, swarm.radio.switch_roles, swarm.links[graph[which % len(graph)]])
    swarm.run(at_last(frames) + 60.0)
    assert not swarm.lost
    for way, told in sent.items():
        numbers = [number for number, *_ in told]
        assert [number for _, link, sender, number in swarm.heard if (link, sender) == way] == numbers
    for name, device in swarm.radio.devices.items():
        mine = [link.central.device.name for link in swarm.links.values() if name in link_names(link)]
        assert set(device.roles) == set(mine)
        assert len(device.central_of) == mine.count(name)


def link_names(link):
    return link.central.device.name, link.peripheral.device.name


def test_who_is_called_by_all_and_has_all_roles_switched_is_no_bridge_any_more():
    swarm = Swarm([("a", "hub"), ("b", "hub"), ("c", "hub")], SlotParameters())
    swarm.run(3.0)
    for link in swarm.links.values():
        swarm.radio.switch_roles(link)
    swarm.run(3.0)
    assert [device.roles for device in swarm.radio.devices.values()] == [["hub"]] * 4
    for number, link in enumerate(swarm.links):
        swarm.send(link, "hub", 10, number)
        swarm.send(link, link[0], 10, number)
    swarm.run(3.2)
    assert len(swarm.heard) == 6


def test_who_asks_to_be_central_is_so_while_its_piconet_has_room():
    calls = [*((f"p{number}", "hub") for number in range(MAX_PERIPHERALS)), ("late", "hub")]
    swarm = Swarm(calls, SlotParameters())
    for caller, called in calls:
        swarm.radio.be_central("hub", swarm.links[caller, called])
        swarm.radio.be_central("hub", swarm.links[caller, called])
    assert len(swarm.radio.devices["hub"].central_of) == MAX_PERIPHERALS
    assert swarm.radio.devices["hub"].roles == ["late", "hub"]


def test_pairs_in_a_poor_place_lose_more_packets_than_others():
    def sent_in(losses):
        swarm = Swarm([("a", "b"), ("a", "c")], SlotParameters(loss=0.0))
        swarm.radio.losses.update(losses)
        for number in range(100):
            swarm.send(("a", "b"), "a", 100, number)
            swarm.send(("a", "c"), "a", 100, number)
        swarm.run(60.0)
        return {way: max(at for at, link, _, _ in swarm.heard if link == way) for way in swarm.links}

    good, bad = sent_in({}), sent_in({frozenset("ab"): 0.7})
    assert bad["a", "b"] > 1.5 * good["a", "b"]


def test_a_device_that_falls_silent_is_lost_by_supervision_and_its_name_is_free():
    swarm = Swarm([("a", "b"), ("c", "b"), ("b", "d")], replace(EXACT, supervision=2.0))
    swarm.run(1.0)
    swarm.radio.switch_off("b")
    again = swarm.radio.connect("d", "b")
    heard = []
    swarm.radio.send(again, "d", 10, lambda: heard.append(swarm.time.now))
    swarm.run(2.5)
    assert heard
    assert swarm.lost == []
    swarm.run(3.5)
    assert sorted(link for link, _ in swarm.lost) == [("a", "b"), ("b", "d"), ("c", "b")]
    assert again.up
    assert [device.roles for device in swarm.radio.devices.values()] == [[], ["d"], [], ["d"]]


def test_a_device_that_is_new_under_its_name_keeps_its_link_when_the_old_one_is_lost():
    swarm = Swarm([("a", "b")], replace(EXACT, supervision=2.0))
    swarm.run(1.0)
    swarm.radio.switch_off("a")
    again = swarm.radio.connect("a", "b")
    swarm.run(4.0)
    assert [link for link, _ in swarm.lost] == [("a", "b")]
    heard = []
    swarm.radio.send(again, "b", 10, lambda: heard.append(swarm.time.now))
    swarm.run(5.0)
    assert heard
    assert [device.roles for device in swarm.radio.devices.values()] == [["a"], ["a"]]


def test_a_device_without_power_hears_nothing_whatever_its_neighbours_do_with_the_link():
    swarm = Swarm([("a", "b")], replace(EXACT, supervision=2.0))
    link = swarm.links["a", "b"]
    dead = swarm.radio.devices["a"]
    swarm.run(1.0)
    swarm.radio.switch_off("a")
    swarm.radio.be_central("b", link)
    swarm.send(("a", "b"), "b", 10, 0)
    swarm.run(4.0)
    assert dead.tuned is None
    assert swarm.heard == []
    assert [link for link, _ in swarm.lost] == [("a", "b")]


def test_a_call_of_or_to_a_device_that_loses_its_power_makes_no_link():
    swarm = Made(["a", "b", "c"])
    swarm.call("a", "b")
    swarm.call("c", "a")
    scanned = swarm.calls._answered

    def answered(call, *rest):  # it was heard in a scan, and the power is cut before the answer
        if call.called == "a":
            swarm.radio.switch_off("a")
            swarm.calls.switch_off("a")
        scanned(call, *rest)

    swarm.calls._answered = answered
    swarm.run(40.0)
    assert ("c", "a") not in swarm.made
    assert swarm.failed["c", "a"][0] == ABSENT
    assert ("a", "b") not in swarm.made or not swarm.made["a", "b"][0].up
    swarm.call("b", "c")
    swarm.run(60.0)
    assert ("b", "c") in swarm.made


def test_a_cut_link_is_lost_after_its_supervision_time_out():
    swarm = Swarm([("a", "b"), ("a", "c")], replace(EXACT, supervision=2.0))
    swarm.time.at(10.0, setattr, swarm.radio, "passes", lambda a, b: {a, b} != {"a", "b"})
    swarm.run(20.0)
    assert [link for link, _ in swarm.lost] == [("a", "b")]
    assert 11.8 < swarm.lost[0][1] < 12.1


class Made(Swarm):
    """Robots that call."""

    def __init__(self, names, parameters=EXACT):
        self.time = EventQueue()
        self.radio = SlotRadio(self.time, names, parameters, Random("1 slots"))
        self.calls = Calls(self.time, self.radio)
        self.calls.reachable.update(names)
        self.made, self.failed = {}, {}

    def call(self, caller, called):
        def done(link, reason):
            if link is None:
                self.failed[caller, called] = reason, self.time.now
            else:
                self.made[caller, called] = link, self.time.now

        self.calls.call(caller, called, 30.0, done)


def test_a_call_takes_a_page_scan_of_the_called_one_and_the_set_up():
    swarm = Made(["a", "b"])
    swarm.call("a", "b")
    swarm.run(10.0)
    link, at = swarm.made["a", "b"]
    assert link.up
    assert link.central.device.name == "a"
    # 13 answers wait for a poll after 40 slots each at most, all else for the next even slot.
    assert at < 1.28 + 0.01 + 13 * (44 * SLOT) + 0.1


def test_a_robot_that_scans_more_often_is_met_sooner():
    swarm = Made(["a", "b"], replace(EXACT, scan=0.16))
    swarm.call("a", "b")
    swarm.run(10.0)
    assert swarm.made["a", "b"][1] < 0.16 + 0.01 + 13 * (44 * SLOT) + 0.1


def test_calls_fail_with_their_reasons():
    swarm = Made(["a", "b", "gone"])
    swarm.calls.reachable.discard("gone")
    swarm.call("a", "gone")
    swarm.call("a", "b")
    swarm.run(8.0)
    assert swarm.failed["a", "gone"] == (ABSENT, pytest.approx(5.12))
    assert swarm.made["a", "b"][1] > 5.12  # one page at a time
    swarm.call("a", "b")
    swarm.run(9.0)
    assert swarm.failed["a", "b"][0] == BUSY


def test_a_call_that_waits_for_pages_has_its_whole_time_from_its_own_on():
    """Behind six absent robots, 31 s."""
    absent = [f"gone{n}" for n in range(6)]
    swarm = Made(["a", "b", *absent])
    for name in absent:
        swarm.calls.reachable.discard(name)
        swarm.call("a", name)
    swarm.call("a", "b")
    swarm.run(40.0)
    assert swarm.made["a", "b"][1] > 6 * 5.12


def test_a_piconet_has_room_for_seven():
    names = [f"r{n}" for n in range(MAX_PERIPHERALS + 2)]
    swarm = Made(names)
    for called in names[1:]:
        swarm.call("r0", called)
    swarm.run(40.0)
    assert len(swarm.made) == MAX_PERIPHERALS
    assert [reason for reason, _ in swarm.failed.values()] == [FULL]


def test_all_robots_of_a_full_graph_can_call_each_other_at_once():
    names = [f"r{n}" for n in range(4)]
    swarm = Made(names, SlotParameters())
    pairs = list(itertools.combinations(names, 2))
    for pair in pairs:
        swarm.call(*pair)
    swarm.run(60.0)
    assert swarm.made.keys() == set(pairs)


@given(st.floats(0.001, 10.0), st.integers(1, 99), st.floats(0.0, 0.9), st.floats(0.1, 9.0))
def test_parameters_are_written_as_they_are_read(stay, buffers, loss, scan):
    found = SlotParameters(stay=stay, buffers=buffers, loss=loss, scan=scan)
    assert SlotParameters.parse(found.text()) == found
    assert SlotParameters().text() == ""


def test_parameters_are_read_and_refused_by_name():
    assert SlotParameters.parse("stay=0.2,buffers=6") == SlotParameters(stay=0.2, buffers=6)
    for wrong in ("stay=0", "stay=long", "speed=2", "loss=0.95", "loss=-1", "stay=nan", "spread=1"):
        with pytest.raises(ConfigError):
            SlotParameters.parse(wrong)
