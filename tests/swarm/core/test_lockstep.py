"""Lockstep: bytes, single rules, and the nine holes of the naive protocol (docs/reference/network/lockstep.md), one
test each."""

import dataclasses
from collections import Counter
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lockstep_world import EDGES, RUN, SCHEMA, STATE, World, named

from swarm.core.lockstep import lockstep
from swarm.core.lockstep.actions import Advanced, Compute, Fault, Finished, Save, Send, Waiting, address_of, key_of
from swarm.core.lockstep.frames import (
    MAX_ITERATION,
    STEP,
    WANT,
    Channel,
    HeardNeighbour,
    Snapshot,
    Step,
    Want,
    decode_frame,
    encode_step,
    encode_want,
)
from swarm.core.lockstep.lockstep import Lockstep
from swarm.errors import FrameError, LocalError

OURS = Channel(RUN, 0, 3, SCHEMA)
THEIRS = Channel(RUN, 0, 5, SCHEMA)


def core(neighbours=("r1",), *, size=2, **options):
    return Lockstep("r0", neighbours, OURS, size, **options)


def started(neighbours=("r1",), **options):
    one = core(neighbours, **options)
    one.start(b"a0", 0.0)
    one.actions()
    return one


def at(k, neighbours=("r1",), **options):
    """A core at iteration k that has used x(k-1) of all its neighbours and has nothing else of them."""
    one = started(neighbours, **options)
    for i in range(k):
        for name in neighbours:
            one.receive(name, THEIRS, step_of(i), 0.0)
        one.computed(b"a%d" % ((i + 1) % 10), b"", 0.0)
    one.actions()
    return one


def step_of(k):
    return encode_step(k, b"b%d" % (k % 10), b"b%d" % ((k - 1) % 10) if k else None)


def kinds(actions):
    return [type(action) for action in actions]


# Bytes


def test_channel_text_is_one_key_chunk():
    assert OURS.text == "00000000000000a1-0-3-9f3c21aa"
    assert Channel.parse("00000000000000a1-0-3-9f3c21aa") == OURS


@given(
    st.builds(
        Channel,
        st.integers(0, 2**64 - 1),
        st.integers(0, 2**32 - 1),
        st.integers(0, 2**64 - 1),
        st.integers(0, 2**32 - 1),
    )
)
def test_channel_comes_back_from_its_text(channel):
    assert Channel.parse(channel.text) == channel


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a1-0-3-9f3c21aa",
        "00000000000000A1-0-3-9f3c21aa",
        "00000000000000a1-00-3-9f3c21aa",
        "00000000000000a1-0-03-9f3c21aa",
        "00000000000000a1--1-3-9f3c21aa",
        "00000000000000a1-0-3-9f3c21aa\n",
        "00000000000000a1-4294967296-3-9f3c21aa",
        "00000000000000a1-0-18446744073709551616-9f3c21aa",
        "00000000000000a1-0-٣-9f3c21aa",
    ],
)
def test_a_channel_has_only_one_text(text):
    with pytest.raises(FrameError):
        Channel.parse(text)


@given(st.text(max_size=70))
def test_any_text_is_a_channel_or_a_frame_error(text):
    with suppress(FrameError):
        assert Channel.parse(text).text == text


@pytest.mark.parametrize("field", ["run", "epoch", "incarnation", "schema"])
def test_channel_refuses_numbers_that_do_not_fit(field):
    for value in (-1, 2**64):
        with pytest.raises(LocalError, match=field):
            dataclasses.replace(OURS, **{field: value})


def test_golden_frames():
    assert encode_step(0, b"ab", None).hex() == "01" + "00000000" + "6162"
    assert encode_step(0x01020304, b"ab", b"cd").hex() == "01" + "04030201" + "6162" + "6364"
    assert encode_want(7).hex() == "02" + "07000000"
    assert decode_frame(bytes.fromhex("01000000006162"), 2) == Step(0, b"ab", None)
    assert decode_frame(bytes.fromhex("010403020161626364"), 2) == Step(0x01020304, b"ab", b"cd")
    assert decode_frame(bytes.fromhex("0207000000"), 2) == Want(7)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01\0\0\0",
        b"\x00\0\0\0\0ab",
        b"\x03\0\0\0\0ab",
        encode_want(1) + b"!",
        encode_step(0, b"ab", b"cd"),
        encode_step(1, b"ab", None),
        encode_step(1, b"ab", b"c"),
        encode_step(1, b"ab", b"cde"),
    ],
)
def test_malformed_frames_are_refused_and_counted(data):
    with pytest.raises(FrameError):
        decode_frame(data, 2)
    one = started()
    one.receive("r1", THEIRS, data, 0.0)
    assert one.counters == {"malformed": 1}
    assert one.actions() == []


@given(st.binary(max_size=40), st.integers(0, 8))
def test_any_bytes_are_a_frame_or_a_frame_error(data, size):
    try:
        frame = decode_frame(data, size)
    except FrameError:
        return
    assert data == (encode_want(frame.k) if isinstance(frame, Want) else encode_step(*frame))


SNAPSHOT = Snapshot(
    run=RUN,
    epoch=2,
    schema=SCHEMA,
    size=2,
    k=7,
    value=b"a7",
    previous=b"a6",
    heard={"r1": HeardNeighbour(5, 8, [b"b6", b"b7", b"b8"]), "r2": HeardNeighbour()},
    private=b"secret",
)
SNAPSHOT_BYTES = bytes.fromhex(
    "424c5331"  # BLS1
    "a100000000000000 02000000 aa213c9f 02000000 07000000"  # run, epoch, schema, size, k
    "02 06000000"  # neighbours, length of the private part
    "6137 6136"  # own x(7), x(6)
    "0500000000000000 01 08000000 07 02 7231 6236 6237 6238"  # incarnation, known, reached, slots, name, values
    "0000000000000000 00 00000000 00 02 7232"  # nothing known of r2 yet
    "736563726574"  # private
    "ab4cf8dd"  # crc32
)


def test_golden_snapshot():
    assert SNAPSHOT.encode().hex() == SNAPSHOT_BYTES.hex()
    assert Snapshot.decode(SNAPSHOT_BYTES) == SNAPSHOT


@given(st.data())
def test_a_snapshot_that_is_not_whole_is_refused(data):
    cut = data.draw(st.integers(0, len(SNAPSHOT_BYTES) - 1))
    bit = data.draw(st.integers(0, 8 * len(SNAPSHOT_BYTES) - 1))
    flipped = bytearray(SNAPSHOT_BYTES)
    flipped[bit // 8] ^= 1 << bit % 8
    for wrong in (SNAPSHOT_BYTES[:cut], bytes(flipped), SNAPSHOT_BYTES + b"!"):
        with pytest.raises(LocalError, match=r"snapshot: (not one|truncated or damaged)"):
            Snapshot.decode(wrong)


@given(st.binary(max_size=80))
def test_any_bytes_are_no_snapshot(data):
    for wrong in (data, b"BLS1" + data):
        with pytest.raises(LocalError, match="snapshot"):
            Snapshot.decode(wrong)


# The host's side


def test_actions_come_in_the_order_of_the_rule():
    one = core(last=1)
    one.start(b"a0", 0.0, b"p")
    save, *rest = one.actions()
    assert Snapshot.decode(save.snapshot.encode()).private == b"p"
    assert rest == [Send(encode_step(0, b"a0", None), None), Advanced(0, b"a0")]
    one.receive("r1", THEIRS, step_of(0), 0.0)
    assert one.actions() == [Compute(0, b"a0", {"r1": b"b0"})]
    one.computed(b"a1", b"q", 0.0)
    save, *rest = one.actions()
    assert Snapshot.decode(save.snapshot.encode()).private == b"q"
    assert rest == [Send(encode_step(1, b"a1", b"a0"), None), Advanced(1, b"a1"), Finished(1)]


def test_values_are_sorted_by_name_whatever_the_order_of_arrival():
    one = started(("r2", "r10", "r1"))
    for name in ("r2", "r1", "r10"):
        one.receive(name, THEIRS, step_of(0), 0.0)
    (compute,) = one.actions()
    assert list(compute.values) == ["r1", "r10", "r2"]


def test_one_compute_at_a_time_while_the_next_values_arrive():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.actions()
    one.receive("r1", THEIRS, step_of(1), 0.1)
    assert one.actions() == []
    one.computed(b"a1", b"", 5.0)
    assert kinds(one.actions()) == [Save, Send, Advanced, Compute]
    assert one.next_deadline() is None


def test_a_lone_robot_iterates_freely():
    one = core((), last=3)
    one.start(b"a0", 0.0)
    seen = []
    while actions := one.actions():
        seen += kinds(actions)
        if isinstance(actions[-1], Compute):
            one.computed(b"a%d" % (actions[-1].k + 1), b"", 0.0)
    assert seen == [Save, Advanced, Compute] * 3 + [Save, Advanced, Finished]
    assert one.done
    assert one.next_deadline() is None


def test_misuse_is_a_local_error():
    one = core()
    with pytest.raises(LocalError, match="comes first"):
        one.receive("r1", THEIRS, step_of(0), 0.0)
    with pytest.raises(LocalError, match="3 bytes, expected 2"):
        one.start(b"a00", 0.0)
    one.start(b"a0", 0.0)
    with pytest.raises(LocalError, match="for a new core"):
        one.start(b"a0", 0.0)
    with pytest.raises(LocalError, match="for a new core"):
        one.resume(b"", 0.0)
    with pytest.raises(LocalError, match="without a Compute"):
        one.computed(b"a1", b"", 0.0)
    with pytest.raises(LocalError, match="its own neighbour"):
        Lockstep("r0", ["r0"], OURS, 2)
    with pytest.raises(LocalError, match="last iteration"):
        core(last=MAX_ITERATION + 1)
    with pytest.raises(LocalError, match="256 neighbours"):
        core([f"n{i}" for i in range(256)])


# Who is listened to


def test_frames_of_others_are_dropped_and_counted():
    one = started()
    one.receive("r1", dataclasses.replace(THEIRS, run=RUN + 1), step_of(0), 0.0)
    one.receive("r1", dataclasses.replace(THEIRS, epoch=1), step_of(0), 0.0)
    one.receive("r1", dataclasses.replace(THEIRS, schema=1), encode_step(0, b"longer", None), 0.0)
    one.receive("r9", THEIRS, step_of(0), 0.0)
    one.receive("r0", OURS, step_of(0), 0.0)
    one.receive("r0", dataclasses.replace(OURS, incarnation=2), step_of(0), 0.0)
    assert one.counters == {"other run": 1, "other epoch": 1, "other version": 1, "unknown sender": 1, "own frame": 2}
    assert one.actions() == []
    assert one.waiting_for == ("r1",)


def test_an_older_incarnation_is_ignored():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.actions()
    older = dataclasses.replace(THEIRS, incarnation=4)
    one.receive("r1", older, encode_step(1, b"zz", b"b0"), 0.0)
    one.receive("r1", older, encode_step(0, b"zz", None), 0.0)
    one.receive("r1", older, encode_want(0), 0.0)
    assert one.counters == {"old incarnation": 3}
    assert one.actions() == []


def test_a_malformed_frame_does_not_claim_an_incarnation():
    one = started()
    one.receive("r1", dataclasses.replace(THEIRS, incarnation=99), b"junk", 0.0)
    one.receive("r1", THEIRS, step_of(0), 0.0)
    assert kinds(one.actions()) == [Compute]


# Around silent links


def asked(neighbours=("r1", "r2")):
    """Has asked all its neighbours for x(1), 0.2 s after it was there."""
    one = at(1, neighbours)
    one.handle_timer(0.2)
    one.actions()
    return one


def test_who_does_not_answer_is_talked_to_around_its_link():
    one = asked()
    one.receive("r2", THEIRS, step_of(0), 0.25)  # it waits for others, but can be heard
    assert one.next_deadline() == pytest.approx(0.2 + 0.1)
    one.handle_timer(0.3001)
    assert one.actions() == [
        Send(encode_step(1, b"a1", b"a0"), "r1", around=True),
        Send(encode_want(1), "r1", around=True),
    ]
    assert one.counters["links gone around"] == 1
    assert one.next_deadline() == pytest.approx(0.4)


def test_a_slow_link_has_one_and_a_half_round_trips_to_answer():
    one = at(1, rtt=0.5)
    one.handle_timer(1.5)
    assert wants(one.actions()) == [("r1", encode_step(1, b"a1", b"a0")), ("r1", encode_want(1))]
    assert one.next_deadline() == pytest.approx(1.5 + 1.5 * 0.5)


def test_at_the_first_iteration_nothing_goes_around_before_who_is_waited_for_is_named():
    one = started()
    sent = []
    while one.next_deadline() < 2.499:
        one.handle_timer(one.next_deadline())
        sent += [action for action in one.actions() if isinstance(action, Send)]
    assert sent
    assert not any(action.around for action in sent)
    assert one.next_deadline() == pytest.approx(2.5)
    one.handle_timer(2.501)
    assert [action.around for action in one.actions() if isinstance(action, Send)] == [True, True]


def test_what_follows_goes_around_at_once_until_the_link_speaks():
    one = asked()
    one.handle_timer(0.38)
    one.actions()
    for peer in ("r1", "r2"):
        one.receive(peer, THEIRS, step_of(1), 0.5, around=True)
    one.computed(b"a2", b"", 0.5)
    frame = encode_step(2, b"a2", b"a1")
    sends = [action for action in one.actions() if isinstance(action, Send)]
    assert sends == [Send(frame, None), Send(frame, "r1", around=True), Send(frame, "r2", around=True)]
    one.receive("r1", THEIRS, step_of(2), 0.6)
    one.receive("r2", THEIRS, step_of(2), 0.7, around=True)
    one.computed(b"a3", b"", 0.7)
    sends = [action for action in one.actions() if isinstance(action, Send)]
    assert sends == [Send(encode_step(3, b"a3", b"a2"), None), Send(encode_step(3, b"a3", b"a2"), "r2", around=True)]


def test_who_comes_around_with_what_is_missing_is_answered_around():
    one = at(1, ("r1", "r2"))
    one.receive("r2", THEIRS, step_of(1), 0.04)
    one.receive("r1", THEIRS, step_of(1), 0.1, around=True)
    one.computed(b"a2", b"", 0.1)
    assert Send(encode_step(2, b"a2", b"a1"), "r1", around=True) in one.actions()


def test_what_the_link_has_overtaken_changes_nothing():
    one = at(1, ("r1", "r2"))
    one.receive("r1", THEIRS, step_of(1), 0.04)
    one.receive("r1", THEIRS, step_of(1), 0.1, around=True)
    one.receive("r2", THEIRS, step_of(1), 0.1)
    one.computed(b"a2", b"", 0.1)
    assert not any(action.around for action in one.actions() if isinstance(action, Send))


def test_a_question_that_came_around_is_answered_around():
    one = at(2)
    one.receive("r1", THEIRS, encode_want(2), 1.0, around=True)
    assert one.actions() == [Send(encode_step(2, b"a2", b"a1"), "r1", around=True)]


@pytest.mark.parametrize(
    ("to", "around", "end"),
    [(None, False, ""), ("r1", False, "/r1"), ("around", False, "/around"), ("r1", True, "/r1/around")],
)
def test_the_key_of_a_frame_says_its_way(to, around, end):
    channel = f"swarm/r0/app/balance/sync/{THEIRS.text}"
    key = key_of(channel, to, around=around)
    assert key == channel + end
    assert address_of(key) == ("r0", "balance", THEIRS.text, to, around)


@pytest.mark.parametrize(
    "key",
    [
        *("", "swarm/stop", "swarm/r0/app/a/sync", "swarm/r0/app/a/latest/c", "swarm/r0/mesh/a/sync/c"),
        *("swarm/r0/app/a/sync/c/r1/x", "swarm/r0/app/a/sync/c/r1/around/x"),
    ],
)
def test_other_keys_are_no_frames(key):
    assert address_of(key) is None


def test_keys_that_are_made_up_cost_no_memory():
    for number in range(1000):
        address_of(f"swarm/r0/app/a/sync/{number}")
        address_of(f"no frame's {number}")
    assert address_of.cache_info().currsize <= 256


def test_a_loop_goes_on_around_a_link_that_carries_nothing():
    world = World(named(EDGES["loop"](4)), 60)
    world.start_all()
    world.run(0.5)
    world.cut_link(("r0", "r1"))
    assert world.run(60 * 0.2, until=world.finished)
    assert world.around > 0


def test_a_line_has_no_way_around_and_waits():
    world = World(named(EDGES["line"](4)), 60)
    world.start_all()
    world.run(0.5)
    world.cut_link(("r1", "r2"))
    assert not world.run(30.0, until=world.finished)
    world.mend_link(("r1", "r2"))
    assert world.run(5.0, until=world.finished)


# WANT


def wants(actions):
    return [(action.to, action.data) for action in actions if isinstance(action, Send) and not action.around]


def test_what_is_missing_is_asked_for_with_the_own_frame_beside_it():
    one = at(1, ("r1", "r2"))
    one.receive("r2", THEIRS, step_of(1), 0.05)
    assert one.next_deadline() == pytest.approx(0.2)
    one.handle_timer(0.1999)
    assert one.actions() == []
    one.handle_timer(0.2)
    assert wants(one.actions()) == [("r1", encode_step(1, b"a1", b"a0")), ("r1", encode_want(1))]


def test_the_question_comes_again_for_ever_at_most_once_a_second():
    one = at(1)
    asked = []
    while len(asked) < 8:
        now = one.next_deadline()
        one.handle_timer(now)
        if sent := wants(one.actions()):
            assert len(sent) == 2
            asked.append(now)
    gaps = [b - a for a, b in zip([0.0, *asked], asked, strict=False)]
    assert gaps[:3] == pytest.approx([0.2, 0.2, 0.4])
    assert max(gaps) == pytest.approx(1.0)
    assert gaps[-1] == pytest.approx(1.0)


def test_the_first_question_waits_for_a_fifth_of_a_second_or_three_round_trips():
    one = at(1)
    one.rtt = 0.5
    assert one.next_deadline() == pytest.approx(0.2)
    one.receive("r1", THEIRS, step_of(1), 0.0)
    one.computed(b"a2", b"", 0.0)
    assert one.next_deadline() == pytest.approx(1.5)


def test_neighbours_that_are_yet_to_start_are_given_longer():
    assert started(rtt=0.001).next_deadline() == pytest.approx(1.0)
    slow = started(rtt=0.5)
    assert slow.next_deadline() == pytest.approx(1.5)
    slow.handle_timer(1.5)
    slow.handle_timer(3.0)
    assert slow._questions.due == pytest.approx(4.5)


@pytest.mark.parametrize("k", [1, 2])
def test_want_for_the_last_two_iterations_is_answered_to_the_asker_alone(k):
    one = at(2, ("r1", "r2"))
    one.receive("r1", THEIRS, encode_want(k), 1.0)
    assert one.actions() == [Send(encode_step(2, b"a2", b"a1"), "r1")]


def test_want_for_what_is_not_computed_yet_is_answered_since_the_link_carries():
    one = at(2)
    one.receive("r1", THEIRS, encode_want(3), 1.0)
    assert one.actions() == [Send(encode_step(2, b"a2", b"a1"), "r1")]


def test_want_is_answered_once_a_round_trip():
    one = at(2, ("r1", "r2"))
    for peer, k, now in (("r1", 2, 1.0), ("r1", 2, 1.05), ("r1", 1, 1.05), ("r2", 2, 1.05), ("r1", 1, 1.2)):
        one.receive(peer, THEIRS, encode_want(k), now)
    assert [action.to for action in one.actions()] == ["r1", "r1", "r2", "r1"]
    assert one.counters["want suppressed"] == 1


def test_data_never_triggers_data():
    one = at(2)
    for k in (1, 0, 1, 2, 2):
        one.receive("r1", THEIRS, step_of(k), 1.0)
    assert kinds(one.actions()) == [Compute]
    assert one.counters == {"duplicate": 3, "late": 1}


def test_link_up_moves_the_question_to_now_and_nothing_else():
    one = started(("r1", "r2"))
    one.nudge(0.08)
    assert one.actions() == []
    assert one.next_deadline() == 0.08
    one.handle_timer(0.08)
    assert len(wants(one.actions())) == 4
    one.nudge(0.09)  # six links that come up together are one reason to ask
    assert one.next_deadline() == pytest.approx(0.14)
    one.receive("r1", THEIRS, step_of(0), 0.1)
    one.receive("r2", THEIRS, step_of(0), 0.1)
    one.nudge(0.11)
    assert one.next_deadline() is None


def test_link_up_asks_for_nothing_that_may_be_on_its_way():
    """A host hears first of a link that has been up all the time, in the middle of an iteration."""
    one = at(2)
    one.nudge(0.01)
    assert one.next_deadline() == pytest.approx(0.06)
    one.receive("r1", THEIRS, step_of(2), 0.05)
    assert one.next_deadline() is None


# Waiting


def test_robots_waited_for_are_named_within_three_seconds():
    one = at(1, ("r1", "r2", "r3"))
    one.receive("r2", THEIRS, step_of(1), 0.1)
    said = []
    while one.next_deadline() < 3.0:
        now = one.next_deadline()
        one.handle_timer(now)
        said += [action for action in one.actions() if isinstance(action, Waiting)]
    assert said == [Waiting(1, ("r1", "r3"))]
    assert one.waiting_for == ("r1", "r3")
    one.receive("r3", THEIRS, step_of(1), 4.0)
    assert one.actions() == [Waiting(1, ("r1",))]
    one.receive("r1", THEIRS, step_of(1), 5.0)
    assert [type(action) for action in one.actions()] == [Waiting, Compute]
    assert one.waiting_for == ()


def test_the_end_of_a_wait_is_said():
    one = at(1)
    one.handle_timer(2.6)
    assert one.actions()[-1] == Waiting(1, ("r1",))
    one.receive("r1", THEIRS, step_of(1), 2.7)
    assert one.actions()[0] == Waiting(1, ())


def test_an_own_slow_step_names_nobody():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.actions()
    one.handle_timer(10.0)
    assert one.actions() == []


# Restart


def last_save(one, k):
    for i in range(one.k, k):
        one.receive("r1", THEIRS, step_of(i), 0.0)
        one.computed(b"a%d" % (i + 1), b"private %d" % (i + 1), 0.0)
    return [action.snapshot.encode() for action in one.actions() if isinstance(action, Save)][-1]


def resumed(saved, incarnation=4, **options):
    channel = dataclasses.replace(OURS, incarnation=incarnation)
    again = Lockstep("r0", ("r1",), channel, 2, **options)
    return again, again.resume(saved, 100.0)


def test_a_restarted_robot_sends_its_frame_asks_and_says_where_it_is():
    again, private = resumed(last_save(started(), 3))
    assert private == b"private 3"
    assert again.actions() == [
        Send(encode_step(3, b"a3", b"a2"), None),
        Advanced(3, b"a3"),
        Send(encode_want(3), "r1"),
    ]
    assert again.next_deadline() == pytest.approx(100.1)
    again.handle_timer(100.1)
    assert wants(again.actions()) == []
    assert again.next_deadline() == pytest.approx(100.2)


def test_a_compute_outstanding_at_the_kill_is_issued_again():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.receive("r1", THEIRS, step_of(1), 0.0)  # it will be in the next snapshot
    again, _ = resumed(last_save(one, 1))
    assert again.actions()[-1] == Compute(1, b"a1", {"r1": b"b1"})


def test_what_was_used_is_still_compared_after_a_restart():
    again, _ = resumed(last_save(started(), 3))
    again.receive("r1", THEIRS, encode_step(2, b"zz", b"b1"), 100.0)
    assert "two values for one iteration: r1" in again.fault


def test_a_late_copy_after_a_restart_is_no_lost_state():
    again, _ = resumed(last_save(started(), 3))
    again.receive("r1", THEIRS, step_of(0), 100.0)
    assert again.fault is None


def test_a_snapshot_of_something_else_is_refused():
    saved = last_save(started(), 3)
    for neighbours, channel, size, said in (
        (("r1",), dataclasses.replace(OURS, run=1), 2, "run 00000000000000a1, this is run 0000000000000001"),
        (("r1",), dataclasses.replace(OURS, epoch=1), 2, "epoch 0, this is epoch 1"),
        (("r1",), dataclasses.replace(OURS, schema=1), 2, "schema 9f3c21aa, this is schema 00000001"),
        (("r1",), OURS, 3, "state size 2, this is state size 3"),
        (("r1", "r2"), OURS, 2, "neighbours r1, this is neighbours r1 r2"),
    ):
        with pytest.raises(LocalError, match=f"^snapshot: {said}"):
            Lockstep("r0", neighbours, channel, size).resume(saved, 0.0)
    with pytest.raises(LocalError, match="beyond the last"):
        core(last=2).resume(saved, 0.0)
    with pytest.raises(LocalError, match="truncated"):
        core().resume(saved[:-1], 0.0)


# Faults


def test_two_values_for_one_iteration():
    for k in (1, 2, 3):  # used already, to be used, ahead
        one = at(2)
        one.receive("r1", THEIRS, step_of(3 if k == 3 else 2), 0.0)
        one.actions()
        one.receive("r1", THEIRS, encode_step(k, b"zz", step_of(k)[7:]), 0.0)
        (fault,) = one.actions()
        assert fault == Fault(f"two values for one iteration: r1 sent two different states for iteration {k}")
        if k > 1:
            one.computed(b"a3", b"", 0.0)  # the answer to the step that was running does not get out
        assert one.actions() == []
        assert one.next_deadline() is None


def test_the_value_beside_is_compared_too():
    one = at(2)
    one.receive("r1", THEIRS, encode_step(2, b"b2", b"zz"), 0.0)
    assert one.actions() == [Fault("two values for one iteration: r1 sent two different states for iteration 1")]


@pytest.mark.parametrize("frame", [step_of(4), encode_want(4)])
def test_a_neighbour_two_ahead_means_that_we_lost_our_state(frame):
    one = at(2)
    one.receive("r1", THEIRS, frame, 0.0)
    assert one.actions() == [Fault("state lost at r0: r1 is at iteration 4, this robot at 2")]


@pytest.mark.parametrize("frame", [step_of(0), encode_want(0)])
def test_a_neighbour_that_came_back_too_far_behind_has_lost_its_state(frame):
    one = at(2)
    one.receive("r1", dataclasses.replace(THEIRS, incarnation=6), frame, 0.0)
    fault, *answer = one.actions()
    assert fault == Fault("state lost at r1: it came back at iteration 0 (incarnation 6), this robot is at 2")
    # The one that is lost is told, again and again, since the answer may be lost too.
    told = Send(encode_step(2, b"a2", b"a1"), "r1")
    assert answer == ([told] if frame == encode_want(0) else [])
    one.receive("r1", dataclasses.replace(THEIRS, incarnation=6), encode_want(0), 1.0)
    assert one.actions() == [told]


# The last iteration


def test_a_robot_at_the_last_iteration_stays_until_all_are_there():
    one = at(3, ("r1", "r2"), last=3)
    assert not one.done
    one.receive("r1", THEIRS, encode_want(2), 1.0)  # it lost x(2)
    assert kinds(one.actions()) == [Send]
    one.receive("r1", THEIRS, step_of(3), 1.1)
    one.receive("r2", THEIRS, encode_want(3), 1.2)
    assert one.done
    assert [action.to for action in one.actions()] == ["r2"]
    assert one.next_deadline() is None


def test_it_leaves_after_a_time_out():
    one = at(3, ("r1", "r2"), last=3, linger=4.0)
    while not one.done:
        now = one.next_deadline()
        one.handle_timer(now)
        assert not any(isinstance(action, Waiting) for action in one.actions())  # nothing waits any more
    assert now == 4.0


def test_nothing_is_left_to_do_where_zero_is_the_last():
    one = core(last=0)
    one.start(b"a0", 0.0)
    assert kinds(one.actions()) == [Save, Send, Advanced, Finished]
    one.receive("r1", THEIRS, step_of(0), 0.0)
    assert one.done


def test_a_robot_restarted_at_its_last_iteration_is_finished_at_once():
    again, _ = resumed(last_save(started(last=3), 3), last=3)
    assert Finished(3) in again.actions()
    again.receive("r1", THEIRS, step_of(3), 100.0)
    assert again.done


# Swarms

SHAPES = [("line", 2), ("line", 6), ("loop", 6), ("full", 6)]


@pytest.mark.parametrize(("shape", "n"), SHAPES)
@pytest.mark.parametrize("jitter", [0.0, 0.02])
def test_without_loss_there_is_one_message_per_neighbour_and_iteration(shape, n, jitter):
    world = World(named(EDGES[shape](n)), 30, jitter=jitter, linger=10.0)
    world.start_all()
    assert world.run(30 * (world.latency + jitter) + 1e-6, until=world.finished)
    world.run(1.0)
    assert world.sent == {(a, b, STEP): 31 for a in world.neighbours for b in world.neighbours[a]}
    assert all(process.core.done for process in world.everyone)
    assert world.faults == []


@pytest.mark.parametrize(("shape", "n"), SHAPES)
def test_an_iteration_takes_one_latency(shape, n):
    world = World(named(EDGES[shape](n)), 40)
    world.start_all()
    assert world.run(60.0, until=world.finished)
    assert world.now == pytest.approx(40 * world.latency)


def messages(world):
    return sum(world.sent.values())


def test_hole_1_resends_of_others_do_not_keep_a_robot_from_asking():
    """A start on the full graph with losses took 12 s with a timer that any traffic winds, once for ever."""
    world = World(named(EDGES["full"](6)), 1, seed=4)
    world.loss = 0.35
    world.start_all()
    assert not world.run(0.3, until=world.finished)
    world.loss = 0.0
    assert world.run(1.0, until=world.finished)
    # And one by one: r0 has all but r5; another one keeps talking to it.
    one = at(1, ("r1", "r5"))
    for i in range(25):
        one.receive("r1", THEIRS, step_of(1), i / 100)
    one.actions()
    one.handle_timer(0.25)
    assert wants(one.actions())[-1] == ("r5", encode_want(1))


def test_hole_2_no_storm_of_old_values():
    """Both sides a little apart, both frames come again: nothing comes of it."""
    world = World([("r0", "r1")], 50)
    world.copies = 1.0
    world.start_all()
    assert world.run(60.0, until=world.finished)
    world.run(5.0)
    assert messages(world) == 2 * 51


def test_hole_3_both_values_are_in_one_message():
    one = at(1)
    one.receive("r1", THEIRS, step_of(2), 0.0)  # the frame of iteration 1 was lost
    assert one.actions() == [Compute(1, b"a1", {"r1": b"b1"})]
    one.computed(b"a2", b"", 0.0)
    assert one.actions()[-1] == Compute(2, b"a2", {"r1": b"b2"})


@pytest.mark.parametrize("actions", range(8))
def test_hole_4_a_killed_app_goes_on_with_its_private_state(actions):
    """Killed after every single action in turn; the world compares each value with the undisturbed run."""
    world = World(named(EDGES["line"](3)), 30)
    world.compute = 0.004
    world.start_all()
    world.run(0.3)
    world.one("r1").dies_after = actions
    world.run(0.5)
    assert world.processes["r1"] == []
    world.start("r1")
    assert world.run(3.0, until=world.finished)


def test_hole_5_a_previous_run_and_a_second_process():
    world = World(named(EDGES["line"](3)), 100)
    world.start_all()
    world.run(0.3)
    victim = world.one("r1")
    ghost = dataclasses.replace(world.one("r0").channel, run=RUN - 1, incarnation=9)
    for k in (victim.core.k, victim.core.k + 1):
        victim.receive("r0", ghost.text, encode_step(k, STATE.pack(-1.0), STATE.pack(-2.0)))
    assert victim.core.counters["other run"] == 2

    told = []
    world.on_fault = lambda process, reason: told.append((process.incarnation, reason))
    world.start("r1")
    assert world.run(6.0, until=world.finished)
    assert told == [(0, "another process runs this app on r1 (incarnation 1, this one is 0)")]
    assert world.one("r0").core.counters["old incarnation"] >= 0


def test_hole_6_a_robot_at_the_end_does_not_strand_its_neighbour():
    world = World([("r0", "r1")], 10, linger=10.0)
    world.leave_when_done = True
    world.start_all()
    world.run(9 * world.latency + 0.001)  # x(9) of both is on its way
    world.cut_link(("r0", "r1"))
    world.one("r0").receive(
        "r1", world.one("r1").channel.text, encode_step(9, world.truth["r1"][9], world.truth["r1"][8])
    )
    assert world.reached == {"r0": 10, "r1": 9}
    world.run(5.0)
    assert world.processes["r0"], "gone while its neighbour lacks x(9)"
    world.mend_link(("r0", "r1"))
    assert world.run(1.0, until=world.finished)
    world.run(0.2)
    assert world.everyone == []


def test_hole_7_members_are_fixed_and_other_epochs_are_not_heard():
    """The policy is to wait: nobody is dropped, so no two epochs can come about."""
    world = World(named(EDGES["line"](3)), 50)
    world.start_all()
    world.run(0.3)
    world.kill("r2")
    world.run(600.0)
    assert {process.core.channel.epoch for process in world.everyone} == {0}
    assert world.one("r1").waits[-1][2] == ("r2",)
    r1 = world.one("r1")
    wrong = encode_step(r1.core.k, STATE.pack(-1.0), STATE.pack(-1.0))
    r1.receive("r2", dataclasses.replace(r1.channel, epoch=1, incarnation=9).text, wrong)
    assert r1.core.counters["other epoch"] == 1
    world.start("r2")
    assert world.run(3.0, until=world.finished)


def test_hole_8_no_link_up_is_needed():
    world = World([("r0", "r1")], 60)
    world.start_all()
    world.run(0.5)
    world.cut_link(("r0", "r1"))
    world.run(20.0)
    world.cut.clear()  # the link is back and nobody was told
    assert world.run(1.0 + 60 * world.latency, until=world.finished)


def test_hole_9_sums_do_not_depend_on_the_order_of_arrival():
    """The world's step shows any other order in its last bits, and every value is compared."""
    for seed in range(5):
        world = World(named(EDGES["full"](5)), 20, seed=seed, jitter=0.05)
        world.start_all()
        assert world.run(10.0, until=world.finished)


def test_no_want_storm_on_the_full_graph():
    """Six robots all joined, 4.8 % of the messages lost on each bus: few messages more than without loss."""
    world = World(named(EDGES["full"](6)), 200, seed=1)
    world.loss = 0.048
    world.start_all()
    assert world.run(200.0, until=world.finished)
    needed = 30 * 201
    counters = sum((process.core.counters for process in world.everyone), Counter())
    asked = counters["want sent"]
    # Each question brings its own frame and at most one answer, and a frame alone never brings one. Where a question
    # or its answer was lost, too, the same goes around the link.
    assert messages(world) <= needed + 3 * (asked + counters["links gone around"])
    assert counters["want answered"] <= asked
    assert messages(world) < 1.5 * needed


def test_no_want_storm_where_links_are_out_one_twentieth_of_the_time():
    world = World(named(EDGES["full"](6)), 400, seed=2)
    world.start_all()
    for i in range(400):
        edge = world.edges[i % 15]
        world.at(i * 0.18, lambda edge=edge: world.cut_link(edge))
        world.at(i * 0.18 + 0.13, lambda edge=edge: world.mend_link(edge))  # each link is out 0.13 of 2.7 s
    assert world.run(90.0, until=world.finished)
    assert messages(world) < 1.25 * 30 * 401


def test_a_robot_that_lost_its_snapshot_is_named():
    world = World(named(EDGES["line"](4)), 100)
    told = {}
    world.on_fault = lambda process, reason: told.setdefault(process.robot, reason)
    world.start_all()
    world.run(1.0)
    world.kill("r1")
    del world.disk["r1"]
    world.start("r1")
    world.run(3.0)
    assert set(told) == {"r0", "r1", "r2"}  # itself and its neighbours
    assert all(reason.startswith("state lost at r1:") for reason in told.values())
    assert world.one("r3").waits[-1][2] == ("r2",)
    assert world.one("r1").core.k == 0


@pytest.mark.parametrize("before", [1, 4])
def test_a_robot_that_lost_snapshot_and_incarnation_finds_out_itself(before):
    """Its first frames look like late copies; the answer to its question tells it."""
    world = World(named(EDGES["line"](3)), 100)
    told = {}
    world.on_fault = lambda process, reason: told.setdefault(process.robot, reason)
    world.start_all()
    for _ in range(before - 1):
        world.run(0.1)
        world.kill("r1")
        world.start("r1")
    world.run(1.0)
    world.kill("r1")
    del world.disk["r1"]
    world.incarnations["r1"] = 0
    world.start("r1")
    world.run(3.0)
    assert told["r1"].startswith("state lost at r1:")
    assert world.one("r0").waits[-1][2] == ("r1",)


def test_a_stopped_robot_is_named_and_the_run_goes_on():
    world = World(named(EDGES["line"](3)), 100)
    world.start_all()
    world.run(1.0)
    world.one("r2").stopped = True
    stopped = world.now
    world.run(5.0)
    (when, _, peers) = world.one("r1").waits[-1]
    assert peers == ("r2",)
    assert when - stopped < 3.0
    assert world.one("r0").waits[-1][2] == ("r1",)
    world.one("r2").go_on()
    assert world.run(6.0, until=world.finished)
    assert world.one("r1").waits[-1][2] == ()


def test_a_second_process_that_nobody_hears_of_does_not_fork_anything():
    """The fence of last resort is gone too (the bus loses the own frames): values stay equal, or a fault is named."""
    world = World(named(EDGES["loop"](3)), 60)
    world.hears_itself = False
    world.on_fault = lambda process, reason: None
    world.start_all()
    world.run(0.5)
    world.start("r1")
    assert world.run(6.0, until=world.finished)


@settings(deadline=None, max_examples=60)
@given(
    shape=st.sampled_from(sorted(EDGES)),
    n=st.integers(3, 6),
    loss=st.floats(0.0, 0.6),
    copies=st.floats(0.0, 1.0),
    seed=st.integers(0, 1000),
)
def test_every_lossy_swarm_comes_to_its_end(shape, n, loss, copies, seed):
    world = World(named(EDGES[shape](n)), 5, seed=seed, jitter=0.02)
    world.loss, world.copies = loss, copies
    world.start_all()
    assert world.run(600.0, until=world.finished)


def test_the_promise_of_three_seconds_leaves_time_for_the_bus():
    assert lockstep.NAME_AFTER <= 2.5
    assert WANT != STEP
