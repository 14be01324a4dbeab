"""Stopping everybody while links and processes come and go: a stop reaches all, and only a re-arm takes it back."""

import contextlib
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st
from overlay_world import World, line, ring, thesis_d
from stop_world import NOTICED, arm, stop, stopped

from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.overlays.stop import (
    AT_ONCE,
    CONFIRM_AFTER,
    FIRST_REPEAT,
    MAX_NAMED,
    MAX_STRANGERS,
    REPEAT_PERIOD,
    SPACING,
    STOP_PERIOD,
    Halt,
    Mark,
    Register,
    encode_halts,
    from_file,
    to_file,
    without_greatest,
)
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import CONTROL, FLOOD
from swarm.errors import FrameError
from swarm.messages import Stop, Stopped
from swarm.messages.codec import decode, encode
from swarm.messages.keys import STOP


def test_a_stop_reaches_all_at_the_speed_of_the_links() -> None:
    world = World(line(6))
    world.settle()
    began = world.now
    stop(world, "r0", "smoke")
    world.run(0.151)
    for place, name in enumerate(world.names[1:], 1):
        (key, payload) = next(sample for sample in world.bots[name].inbox if sample[0] == STOP)
        assert decode(Stop, payload, key).origin == "r0"
        assert decode(Stop, payload, key).reason == "smoke"
        assert world.bots[name].times[0] - began == pytest.approx(place * 0.03)
        assert stopped(world, name).by == {"r0": "smoke"}


def test_a_stop_costs_no_more_messages_than_a_flood() -> None:
    """And each robot's word that it is stopped costs another one."""
    world = World(thesis_d())
    world.settle()
    world.counting = lambda packet: packet.key.endswith("/halt")
    stop(world, "r0")
    world.run(0.5)
    a_flood = 2 * len(thesis_d()) - (len(world.names) - 1)
    assert world.messages[True] == a_flood
    assert world.messages[False] == len(world.names) * a_flood
    stop(world, "r0", "smoke")
    world.run(0.5)
    assert world.messages[False] == len(world.names) * a_flood, "nothing new to say"


def test_a_stop_is_repeated_on_the_bus_until_it_is_taken_back() -> None:
    world = World(line(3))
    world.settle()
    stop(world, "r0")
    world.run(10.5 * STOP_PERIOD)
    heard = [decode(Stop, payload, STOP) for payload in world.got("r2", STOP)]
    assert 10 <= len(heard) <= 12
    assert all(each.repeated and (each.origin, each.reason) == ("r0", "smoke") for each in heard)
    arm(world, "r1")
    world.run(0.1)
    world.clear()
    world.run(10.0)
    assert world.got("r2", STOP) == []
    assert not stopped(world, "r0").stopped


def test_no_late_duplicate_undoes_a_rearm_and_none_undoes_a_stop() -> None:
    world = World(line(3))
    world.settle()
    heard: list[tuple[str, bytes]] = []

    def listen(sender: str, peer: str, packet) -> None:  # type: ignore[no-untyped-def]
        if packet.overlay == FLOOD and packet.key.endswith("/halt") and peer == "r2":
            heard.append((packet.key, packet.payload))

    world.watch = listen
    stop(world, "r0")
    world.run(0.5 * FIRST_REPEAT)
    arm(world, "r0")
    world.run(0.4 * FIRST_REPEAT)
    old = list(heard)
    assert len(old) == 2

    def replay() -> None:
        for key, payload in old * 3:
            world.step("r2", lambda each: each.receive("r1", FLOOD, key, payload, CONTROL, world.now))  # noqa: B023

    replay()
    world.run(1.0)
    assert not any(stopped(world, name).stopped for name in world.names)
    stop(world, "r0", "again")
    world.run(1.0)
    replay()
    world.run(1.0)
    assert all(stopped(world, name).by == {"r0": "again"} for name in world.names)


def test_a_rearm_takes_back_only_what_it_knew_of() -> None:
    world = World(line(4))
    world.settle()
    world.cut("r1", "r2")
    world.run(NOTICED)
    stop(world, "r0", "left half")
    stop(world, "r3", "right half")
    world.run(NOTICED)
    arm(world, "r1")
    world.run(NOTICED)
    assert not stopped(world, "r0").stopped
    world.join("r1", "r2")
    world.run(NOTICED)
    assert all(stopped(world, name).by == {"r3": "right half"} for name in world.names)
    arm(world, "r0")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)


def test_who_comes_into_a_stopped_swarm_is_stopped() -> None:
    world = World(line(3), start=False)
    world.start("r0")
    world.start("r1")
    world.run(1.0)
    stop(world, "r0")
    world.run(1.0)
    world.kill("r0")  # the one who stopped it is gone
    world.start("r2")
    world.run(NOTICED)
    assert stopped(world, "r2").by == {"r0": "smoke"}
    world.start("r0")
    world.run(NOTICED)
    assert stopped(world, "r0").stopped
    arm(world, "r0")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)


def test_a_stop_of_a_robot_that_forgot_its_earlier_ones_holds() -> None:
    """Even with its clock gone back: what counts is greater than all that it hears of its own past."""
    world = World(line(3))
    world.settle()
    for _ in range(5):
        stop(world, "r0")
        world.run(0.5)
        arm(world, "r2")
        world.run(0.5)
    world.kill("r0")
    world.clock_error["r0"] = -900.0
    world.start("r0")
    world.run(NOTICED)
    stop(world, "r0", "now")
    world.run(NOTICED)
    assert all(stopped(world, name).by == {"r0": "now"} for name in world.names)


def test_stops_in_a_loop_do_not_fill_the_links_and_the_last_one_counts() -> None:
    world = World(line(2))
    world.settle()
    for n in range(100):
        stop(world, "r0", f"{n}")
        world.run(0.001)
    assert world.messages[FLOOD] <= AT_ONCE + 2
    world.run(SPACING + 0.1)
    assert stopped(world, "r1").by == {"r0": "99"}


def test_a_stop_that_is_given_right_after_a_rearm_reaches_all_at_the_speed_of_the_links() -> None:
    """The robot has given a stop less than `SPACING` before, which the re-arm has taken back."""
    world = World(line(2))
    world.settle()
    stop(world, "r0", "first")
    world.run(0.031)
    arm(world, "r0")
    world.run(0.001)
    stop(world, "r0", "second")
    world.run(0.031)
    assert stopped(world, "r1").by == {"r0": "second"}


def test_a_lost_stop_is_repeated() -> None:
    world = World(line(2))
    world.settle()
    world.loss = 1.0
    stop(world, "r0")
    world.run(0.9 * FIRST_REPEAT)
    assert not stopped(world, "r1").stopped
    world.loss = 0.0
    world.run(0.2 * FIRST_REPEAT)
    assert stopped(world, "r1").stopped
    arm(world, "r0")
    world.run(1.0)
    world.loss = 1.0
    stop(world, "r0", "again")
    world.run(3.0 * FIRST_REPEAT)
    assert not stopped(world, "r1").stopped
    world.loss = 0.0
    world.run(REPEAT_PERIOD)
    assert stopped(world, "r1").stopped


def told(world: World, name: str) -> dict[str, bool | None]:
    """Who is stopped by its own word, as one robot has heard."""
    return {each.robot: each.stopped for each in world.bots[name].overlays.graph(world.now).robots}


def test_every_robot_learns_who_has_obeyed() -> None:
    world = World(line(6))
    world.settle()
    assert told(world, "r2") == {"r2": False} | dict.fromkeys(["r0", "r1", "r3", "r4", "r5"])
    stop(world, "r0")
    world.run(2 * 0.15 + CONFIRM_AFTER + 0.001)
    assert told(world, "r0") == dict.fromkeys(world.names, True)
    last = [decode(Stopped, payload, "") for payload in world.got("r0", "swarm/r5/mesh/stopped")]
    assert [each.by for each in last] == [{"r0": "smoke"}]
    arm(world, "r3")
    world.run(1.0)
    for name in world.names:
        assert told(world, name) == dict.fromkeys(world.names, False)


def test_who_was_cut_off_is_not_taken_for_stopped() -> None:
    world = World(line(3))
    world.settle()
    world.cut("r1", "r2")
    world.run(NOTICED)
    stop(world, "r0")
    world.run(NOTICED)
    assert told(world, "r0") == {"r0": True, "r1": True, "r2": None}
    world.join("r1", "r2")
    world.run(NOTICED)
    assert told(world, "r0")["r2"]
    # Nor is one that was started anew by the word of its earlier process.
    world.kill("r1")
    world.run(NOTICED)
    world.kill("r0")
    world.kill("r2")
    world.start("r1")
    world.start("r0")
    world.run(NOTICED)
    assert told(world, "r0") == {"r0": False, "r1": None, "r2": None}


def test_stops_on_all_robots_at_once_make_one_confirmation_of_each() -> None:
    world = World(ring(6))
    world.settle()
    world.counting = lambda packet: packet.key.endswith("/stopped")
    for name in world.names:
        stop(world, name)
    world.run(1.0)
    assert world.messages[True] <= 2 * 6 * (2 * 6 - 5)
    assert told(world, "r4") == dict.fromkeys(world.names, True)


def test_what_is_told_of_a_stop_is_bounded() -> None:
    world = World(line(MAX_NAMED + 4))
    world.settle()
    for name in world.names:
        stop(world, name, "x" * 500)
    world.run(2.0)
    shown = stopped(world, "r0")
    assert shown.stopped
    assert len(shown.by) == MAX_NAMED
    last = world.names[-1]
    assert next(iter(stopped(world, last).by)) == last, "a bridge looks for the stop of its own bus"
    assert len(encode(shown)) < packets.MAX_SPREAD


def test_a_stop_counts_beside_robots_that_are_not_in_the_configuration() -> None:
    world = World(line(2))
    world.settle()
    mark = Mark(2**60, 1)

    def hear(halt: Halt) -> None:
        (data,) = encode_halts(halt)
        world.step("r0", lambda each: each.receive("r1", FLOOD, "swarm/r1/mesh/halt", data, CONTROL, world.now))

    hear(Halt({"r1": (mark, "smoke"), "r9": (mark, "elsewhere")}, {}))
    assert stopped(world, "r0").by == {"r1": "smoke", "r9": "elsewhere"}
    hear(Halt({}, {"r1": mark}))
    assert stopped(world, "r0").by == {"r9": "elsewhere"}
    hear(Halt({}, {"r9": mark}))
    assert not stopped(world, "r0").stopped
    assert world.bots["r0"].counters["bad_packets"] == 0


def test_a_stop_of_a_robot_that_others_do_not_know_passes_through_them_and_is_taken_back() -> None:
    """As while another list of robots is brought to the swarm: r9 is a neighbour of r0, and r1 to r3 know no r9."""
    world = World(line(4))
    world.settle()
    (data,) = encode_halts(Halt({"r9": (Mark(2**60, 1), "smoke")}, {}))
    world.step("r0", lambda each: each.receive("r1", FLOOD, "swarm/r1/mesh/halt", data, CONTROL, world.now))
    world.run(NOTICED + FIRST_REPEAT)  # r1, from which it seems to come, is told by the repetition
    assert all(stopped(world, name).by == {"r9": "smoke"} for name in world.names)
    arm(world, "r3")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)


def test_the_stops_of_robots_that_nobody_knows_are_bounded() -> None:
    """Those of known robots, and of the others whose stops are kept, hold and are taken back all the same."""
    world = World(line(2))
    world.settle()

    def hear(stops: list[str], arms: list[str]) -> None:
        for data in encode_halts(
            Halt({name: (Mark(2**60, 1), "") for name in stops}, {name: Mark(2**60, 1) for name in arms})
        ):
            take = partial(RobotOverlays.receive, peer="r1", overlay=FLOOD, key="swarm/r1/mesh/halt", data=data)
            world.step("r0", lambda each, take=take: take(each, priority=CONTROL, now=world.now))  # type: ignore[misc]

    names = [f"x{number}" for number in range(2 * MAX_STRANGERS)]
    hear(names, [])
    hear([], names)
    assert len(from_file(world.kept_stops["r0"]).stops) == MAX_STRANGERS
    assert len(from_file(world.kept_stops["r0"]).arms) == MAX_STRANGERS
    assert world.bots["r0"].counters["bad_packets"] > 0
    assert not stopped(world, "r0").stopped
    hear([names[0], "r1"], [])
    assert stopped(world, "r0").by == {"r1": ""}
    # One that holds takes the room of those that were taken back.
    hear(["z"], [])
    assert stopped(world, "r0").by == {"r1": "", "z": ""}


def test_a_stop_that_holds_is_restored_before_any_number_of_those_that_were_taken_back() -> None:
    """All of them of robots that are no longer in the configuration."""
    world = World(line(2))
    mark = Mark(2**60, 1)
    names = [f"a{number:03}" for number in range(2 * MAX_STRANGERS)]
    kept = Halt(dict.fromkeys((*names, "z"), (mark, "")), dict.fromkeys(names, mark))
    world.step("r0", lambda each: each.restore_stops(kept, world.now))
    assert stopped(world, "r0").by == {"z": ""}


def test_a_word_that_is_none_is_a_bad_packet() -> None:
    world = World(line(2))
    world.settle()
    wrong = packets.encode_spread(packets.Spread(2**60, 1, b"no msgpack"))
    world.step("r0", lambda each: each.receive("r1", FLOOD, "swarm/r1/mesh/stopped", wrong, CONTROL, world.now))
    assert world.bots["r0"].counters["bad_packets"] == 1
    assert world.bots["r0"].inbox == []


def test_a_repeated_rearm_takes_back_no_stop_that_was_given_meanwhile() -> None:
    world = World(line(3))
    world.settle()
    stop(world, "r0", "first")
    world.run(NOTICED)
    arm(world, "r1")
    world.run(0.5)
    stop(world, "r2", "second")
    world.run(0.2)
    for _ in range(5):
        world.run(0.2)
        age = world.now - (2.0 + NOTICED)
        world.step("r1", lambda each, age=age: each.arm(world.now, age))  # type: ignore[misc]
    world.run(NOTICED)
    assert all(stopped(world, name).by == {"r2": "second"} for name in world.names)


@pytest.mark.parametrize("age", [float("nan"), float("inf"), 1e300])
def test_a_rearm_of_an_impossible_age_takes_nothing_back(age: float) -> None:
    world = World(line(2))
    world.settle()
    stop(world, "r0")
    world.run(NOTICED)
    world.step("r1", lambda each: each.arm(world.now, age))
    world.run(NOTICED)
    assert stopped(world, "r0").stopped
    world.step("r1", lambda each: each.arm(world.now, -1e300))
    world.run(NOTICED)
    assert not stopped(world, "r0").stopped


@pytest.mark.parametrize("armed", [False, True])
def test_a_stop_given_before_the_first_link_holds_though_the_clock_went_back(armed: bool) -> None:
    """Marks of its past that neighbours report take no new stop back, whether its old stop was taken back or not."""
    world = World(line(3))
    world.settle()
    stop(world, "r0", "before")
    world.run(0.5)
    if armed:
        arm(world, "r2")
        world.run(0.5)
    world.kill("r0")
    world.clock_error["r0"] = -900.0
    world.start("r0")
    stop(world, "r0", "now")
    states = []
    for _ in range(100):
        world.run(NOTICED / 100)
        states.append(stopped(world, "r0").stopped)
    assert all(states)
    assert all(stopped(world, name).by == {"r0": "now"} for name in world.names)
    assert not any(decode(Stopped, each, "").stopped is False for each in world.got("r0", "r0/mesh/stopped"))
    arm(world, "r2")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)


def test_a_process_that_starts_anew_goes_on_with_the_stops_it_knew() -> None:
    """Before any link is there, and though all robots start anew at the same time."""
    world = World(line(3))
    world.settle()
    stop(world, "r0")
    world.run(NOTICED)
    for name in world.names:
        world.kill(name)
    for name in world.names:
        world.start(name)
        kept = from_file(world.kept_stops[name])
        world.step(name, lambda each, kept=kept: each.restore_stops(kept, world.now))  # type: ignore[misc]
        assert stopped(world, name).by == {"r0": "smoke"}
        assert world.got(name, STOP), "the own bus is told at once"
    world.run(NOTICED)
    arm(world, "r2")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)
    # What was taken back stays so.
    world.kill("r1")
    world.start("r1")
    kept = from_file(world.kept_stops["r1"])
    world.step("r1", lambda each: each.restore_stops(kept, world.now))
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)


def test_a_stop_outlives_the_robot_that_gave_it_being_taken_out_of_the_configuration() -> None:
    """The meshes of the others start anew with the new configuration, and nobody has taken the stop back."""
    world = World(line(3))
    world.settle()
    stop(world, "r2")
    world.run(NOTICED)
    kept = {name: from_file(world.kept_stops[name]) for name in ("r0", "r1")}
    smaller = World(line(2))
    for name in smaller.names:
        smaller.step(name, lambda each, name=name: each.restore_stops(kept[name], smaller.now))  # type: ignore[misc]
        assert stopped(smaller, name).by == {"r2": "smoke"}
    smaller.settle()
    assert all(stopped(smaller, name).stopped for name in smaller.names)
    arm(smaller, "r1")
    smaller.run(NOTICED)
    assert not any(stopped(smaller, name).stopped for name in smaller.names)
    # One that was taken back is none.
    arm(world, "r0")
    world.run(NOTICED)
    kept = {"r0": from_file(world.kept_stops["r0"])}
    fresh = World(line(2))
    fresh.step("r0", lambda each: each.restore_stops(kept["r0"], fresh.now))
    assert not stopped(fresh, "r0").stopped


def test_kept_stops_are_read_as_they_were_written_and_damage_is_named() -> None:
    halt = Halt({f"r{n}": (Mark(n, n), "x" * n) for n in range(50)}, {f"r{n}": Mark(2**60 + n, 1) for n in range(50)})
    data = to_file(halt)
    assert from_file(data) == halt
    for size in range(len(data)):
        with pytest.raises(FrameError):
            from_file(data[:size])
    for at in range(len(data)):
        with pytest.raises(FrameError):
            from_file(data[:at] + bytes((data[at] ^ 4,)) + data[at + 1 :])


def test_kept_stops_silence_no_robot_for_good() -> None:
    """Nothing is above the greatest incarnation, which a member may have told in any name."""
    first, greatest, mark = Mark(7, 1), Mark(packets.MAX_INCARNATION, 1), Mark(5, 1)
    above = Mark(packets.MAX_INCARNATION, 2)
    honest = Halt({"r1": (mark, "smoke"), "r2": (mark, "dog")}, {"r2": mark})
    assert without_greatest(honest, "r0", first) == honest
    # A stop that holds goes on holding, in our own name. What was taken back stays so.
    stops = {"r1": (greatest, "a lie"), "r2": (greatest, "another"), "r3": (mark, "smoke")}
    kept = without_greatest(Halt(stops, {"r2": above, "r3": greatest, "r4": greatest}), "r0", first)
    assert kept == Halt({"r0": (first, "a lie")}, {})
    world = World(line(2))
    world.step("r0", lambda each: each.restore_stops(without_greatest(Halt({}, {"r0": greatest}), "r0", first), 0.0))
    stop(world, "r0")
    assert stopped(world, "r0").stopped


@given(st.binary(max_size=300))
def test_kept_stops_of_any_bytes_are_halts_or_damaged(data: bytes) -> None:
    with contextlib.suppress(FrameError):
        assert isinstance(from_file(data), Halt)


def test_two_robots_with_one_name_do_not_outdo_each_others_stops_without_end() -> None:
    """As with a copied SD card."""
    sent: list[tuple[str, bytes]] = []
    registers: dict[str, Register] = {}
    for place, incarnation in (("here", 5), ("there", 6)):
        registers[place] = Register(
            "r0",
            lambda incarnation=incarnation: incarnation,  # type: ignore[misc]
            frozenset({"r0", "r1"}),
            emit=lambda packet, place=place: sent.append((place, packet.payload)),  # type: ignore[misc]
            changed=lambda: None,
        )
        registers[place].stop(place, 0.0)
        registers[place].link_up("r1")
    messages, now = 0, 0.0
    while now < 10.0:
        now += 0.03
        arriving, sent[:] = list(sent), []
        messages += len(arriving)
        for place, payload in arriving:
            registers["there" if place == "here" else "here"].receive("r1", payload, now)
        for register in registers.values():
            if now >= register.next_deadline():
                register.handle_timer(now)
    assert messages < 60
    assert all(register.stops for register in registers.values())
