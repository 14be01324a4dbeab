"""Links under virtual time: handshake, refusals, silence, restarts, and that they always come up again."""

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from mesh_accidents import ACCIDENTS, recover, suffer
from mesh_world import World
from raw_hello import KEYS, hello

from services.mesh.core.calling import MAX_HALF_OPEN
from services.mesh.core.link.calls import LONGEST_DELAY
from services.mesh.core.wire import frames
from swarm.config.types import MeshConfig

PAIR = [("r0", "r1")]

SYNC_KEY = "swarm/{}/app/consensus/sync/00000000000000a1-0-3-9f3c21aa"

HANDSHAKE_TIMEOUT = MeshConfig().handshake

RECOVERY = 3.0 + 1.5 * LONGEST_DELAY + HANDSHAKE_TIMEOUT + 1.0
"""s in which a link must be up again when nothing disturbs it: silence, the longest wait, a handshake."""


def test_a_link_is_up_after_two_crossings() -> None:
    world = World(PAIR)
    world.run(0.030)  # the dial
    world.run(0.059)
    assert world.link("r0", "r1").state == "connecting"
    world.run(0.002)
    assert world.all_up()
    assert world.link("r0", "r1").connection == 1
    assert world.link("r0", "r1").reason == ""


def test_the_round_trip_time_is_measured() -> None:
    world = World(PAIR, latency=0.040)
    world.run(5.0)
    assert world.link("r0", "r1").rtt == pytest.approx(0.080, abs=1e-5)
    assert world.link("r1", "r0").rtt == pytest.approx(0.080, abs=1e-5)


@pytest.mark.parametrize(("latency", "heartbeats"), [(0.03, 40), (0.12, 40), (0.13, 20), (1.0, 20)])
def test_a_link_has_half_as_many_heartbeats_where_round_trips_are_long(latency: float, heartbeats: int) -> None:
    world = World(PAIR, latency=latency)
    world.run(20.0)
    before = world.link("r0", "r1").sent
    world.run(20.0)
    assert world.link("r0", "r1").sent - before == pytest.approx(3 * heartbeats, abs=4)  # each with clock and receipt


def test_heartbeats_of_all_links_leave_together() -> None:
    world = World([("r0", "r1"), ("r1", "r2")])
    world.run(1.0)
    world.kill("r2")
    world.run(0.33)
    world.start("r2")
    world.run(10.0)
    first, second = world.bots["r1"].ends
    assert first.deadline == second.deadline


def test_messages_arrive_in_order_under_their_own_key() -> None:
    world = World(PAIR)
    world.run(1.0)
    sent = [(SYNC_KEY.format("r0"), str(k).encode()) for k in range(50)]
    for key, payload in sent:
        world.publish("r0", key, payload)
    world.run(0.031)
    assert world.bots["r1"].inbox == sent
    assert not world.bots["r0"].inbox


def test_a_message_to_one_neighbour_goes_nowhere_else() -> None:
    world = World([("r0", "r1"), ("r0", "r2")])
    world.run(1.0)
    world.publish("r0", SYNC_KEY.format("r0") + "/r2", b"want", source=1)
    world.run(1.0)
    assert not world.bots["r1"].inbox
    assert world.bots["r2"].inbox == [(SYNC_KEY.format("r0") + "/r2", b"want")]
    assert world.bots["r0"].counters["sent_sync"] == 1


def test_messages_for_a_link_that_is_down_are_counted() -> None:
    world = World(PAIR)
    world.publish("r0", SYNC_KEY.format("r0"), b"lost")
    assert world.bots["r0"].counters["no_link"] == 1
    world.run(1.0)
    assert not world.bots["r1"].inbox


def test_silence_makes_a_link_suspect_then_down_then_it_returns() -> None:
    world = World(PAIR)
    world.run(1.0)
    world.stop("r1", 10.0)
    world.run(0.9)
    assert world.link("r0", "r1").state == "up"
    world.run(0.7)
    assert world.link("r0", "r1").state == "suspect"
    world.run(1.5)
    assert world.link("r0", "r1").state in ("down", "connecting")
    assert world.link("r0", "r1").reason in ("silent for 3 s", "no handshake within 8 s")
    assert world.bots["r0"].counters["silent"] >= 1
    world.run(10.0 - 3.1 + RECOVERY)
    assert world.all_up()
    assert world.link("r0", "r1").connection == 2


@pytest.mark.parametrize(
    ("up", "latency", "dead"),
    [
        pytest.param(1.0, 0.03, 16.0, id="round trips are not known"),
        pytest.param(20.0, 0.03, 3.0, id="they are short"),
        pytest.param(20.0, 0.2, 8.0, id="they are long"),
        pytest.param(40.0, 1.0, 10.0, id="five of them are longer than a handshake"),
    ],
)
def test_a_silent_link_on_a_radio_with_pages_ends_soon_only_where_round_trips_are_short(
    up: float, latency: float, dead: float
) -> None:
    """There, two robots in several piconets may miss one another for seconds."""
    world = World(PAIR, latency=latency)
    world.overrides["r0"] = {"pages": True}
    world.kill("r0")
    world.start("r0")
    world.run(up)
    connection = world.link("r0", "r1").connection
    assert world.all_up()
    world.cut("r0", "r1", 100.0)
    last = world.now + latency  # what is under way still arrives
    world.run(dead - 1.0)
    assert (world.link("r0", "r1").connection, world.link("r0", "r1").state) == (connection, "suspect")
    world.run(last + dead + 0.1 - world.now)
    assert world.link("r0", "r1").state != "suspect"


def test_a_short_cut_makes_a_link_suspect_only() -> None:
    world = World(PAIR)
    world.run(1.0)
    world.cut("r0", "r1", 2.0)
    world.publish("r0", SYNC_KEY.format("r0"), b"held")
    world.run(1.9)
    assert world.link("r1", "r0").state == "suspect"
    assert not world.bots["r1"].inbox
    world.run(0.5)
    assert world.all_up()
    assert world.link("r1", "r0").connection == 1
    assert world.bots["r1"].inbox == [(SYNC_KEY.format("r0"), b"held")]


def test_a_restarted_robot_waits_for_suspicion_and_not_for_silence() -> None:
    """r0 dials; its old connection is still there, unnoticed, when the new one arrives. Until nothing was heard on the
    old one for 1.5 s, the caller could be another robot with r0's name."""
    world = World(PAIR)
    world.run(2.0)
    for end in world.bots["r0"].ends.values():
        end.peer = None  # the kill is not noticed by r1
    world.kill("r0")
    world.start("r0")
    world.run(2.7)
    assert world.all_up()
    assert world.link("r1", "r0").connection == 2
    world.publish("r1", SYNC_KEY.format("r1"), b"hello again")
    world.run(0.1)
    assert world.bots["r0"].inbox == [(SYNC_KEY.format("r1"), b"hello again")]


def test_a_stopping_mesh_says_so() -> None:
    world = World(PAIR)
    world.run(2.0)
    world.step("r1", lambda node: node.connections.close(world.now))
    world.run(0.04)
    assert world.link("r0", "r1").reason == "the other end says: stopping"
    assert world.bots["r0"].counters["byes"] == 1


@pytest.mark.parametrize(
    ("written", "counter", "reason"),
    [
        (hello(network="other"), "refused_network", "network 'other', ours is 'lab'"),
        (hello("r9"), "refused_robot", "robot r9 is not in our configuration"),
        (hello("r1"), "refused_robot", "which is our own name"),
        (hello(insecure=False), "refused_security", "we are insecure and it is not"),
        (hello(key_ids=(4,)), "bad_frames", "none when insecure"),
        (hello(dialler=False), "refused_role", "both ends claim the same role"),
        (hello("r3"), "refused_role", "r1 is to dial r3"),
        (hello(versions=(4, 5)), "refused_version", "speaks protocol versions 4 to 5, we speak 3"),
        (b"GET / HTTP/1.1\r\n", "bad_frames", "frame length 17735"),
        (b"\x05\x00\x06abcd", "bad_frames", "frame kind 6 before HELLO"),
        (hello() + hello(), "bad_frames", "frame kind 1 before CONFIRM"),
        (b"\x02\x00\x03\x05", "byes", ""),
        (b"", "silent", "no handshake within 8 s"),
        (hello()[:20], "silent", "no handshake within 8 s"),
    ],
)
def test_a_wrong_caller_is_refused_counted_and_logged_once(written: bytes, counter: str, reason: str) -> None:
    world = World([("r0", "r1"), ("r1", "r3"), ("r0", "r2")])
    world.run(1.0)
    before = world.link("r1", "r0")
    for _ in range(3):
        caller = world.connect_raw("r1", written)
        world.run(HANDSHAKE_TIMEOUT + 0.1)
        assert not caller.open
    bot = world.bots["r1"]
    assert bot.counters[counter] == 3
    warnings = [note.text for note in bot.notes if note.problem]
    assert len(warnings) == (1 if reason else 0)
    assert all(reason in warning for warning in warnings)
    after = world.link("r1", "r0")
    assert (after.state, after.connection) == ("up", before.connection)


def test_both_ends_back_off_when_they_do_not_fit() -> None:
    world = World(PAIR)
    world.kill("r1")
    world.network["r1"] = "elsewhere"
    world.start("r1")
    world.run(60.0)
    assert world.link("r0", "r1").state in ("down", "connecting")
    assert "network" in world.link("r0", "r1").reason
    assert 12 <= len(world.dials) <= 30
    refusals = [note for bot in world.bots.values() for note in bot.notes if note.problem]
    assert len(refusals) == 2
    world.kill("r1")
    world.network["r1"] = "lab"
    world.start("r1")
    world.run(RECOVERY)
    assert world.all_up()


def test_whom_we_dialled_must_answer() -> None:
    world = World([("r0", "r1"), ("r0", "r2")])
    world.kill("r1")
    world.overrides["r1"] = {"robot": "r2"}  # r2's configuration on r1's machine
    world.start("r1")
    world.run(1.0)
    assert "robot r2 answers where r1 should be" in world.link("r0", "r1").reason
    assert world.link("r0", "r2").state == "up"


def test_strangers_cannot_fill_the_house() -> None:
    world = World(PAIR)
    world.run(1.0)
    callers = [world.connect_raw("r1") for _ in range(100)]
    assert sum(caller.open for caller in callers) == MAX_HALF_OPEN
    assert world.bots["r1"].counters["half_open"] == 100 - MAX_HALF_OPEN
    assert len([note for note in world.bots["r1"].notes if note.problem]) == 1
    world.run(HANDSHAKE_TIMEOUT + 0.1)
    assert not any(caller.open for caller in callers)
    assert world.all_up()


def test_data_on_a_handle_that_was_never_bound_ends_the_connection() -> None:
    world = World(PAIR)
    world.run(1.0)
    data = frames.encode_data(frames.SYNC, 5, b"x")
    caller = world.connect_raw("r1", hello(), frames.encode_confirm() + data)
    world.run(0.1)
    assert not caller.open
    assert world.bots["r1"].counters["bad_frames"] == 1
    world.run(RECOVERY)
    assert world.all_up()


def test_a_neighbour_cannot_speak_for_others_or_command_us() -> None:
    world = World([("r0", "r1"), ("r1", "r2")])
    world.run(1.0)
    wrong = [
        SYNC_KEY.format("r2"),
        SYNC_KEY.format("r1"),
        "swarm/r0/balancer/set/mode",
        "swarm/r0/app/consensus/set/sync/x",
        "swarm/r0/dwm/pose",
        "swarm/stop",
        SYNC_KEY.format("r0") + "/r2",
        "swarm/r0/app/*/sync/x",
        "swarm/r0/app/con sensus/sync/x",
    ]
    messages = [
        frames.encode_bind(frames.Bind(n, frames.NEIGHBOURS, key)) + frames.encode_data(0, n, b"!")
        for n, key in enumerate(wrong)
    ]
    right = frames.encode_bind(frames.Bind(99, 0, SYNC_KEY.format("r0"))) + frames.encode_data(1, 99, b"ok")
    world.connect_raw("r1", hello(), frames.encode_confirm(), *messages, right)
    world.run(0.1)
    bot = world.bots["r1"]
    assert bot.inbox == [(SYNC_KEY.format("r0"), b"ok")]
    assert bot.counters["inbound_refused"] == len(wrong)
    assert sum("key refused peer=r0" in note.text for note in bot.notes) == 1
    assert world.link("r1", "r2").state == "up"


@costly(75)
@given(st.lists(ACCIDENTS, max_size=25), st.integers(0, 2**16), st.sampled_from((None, KEYS)))
def test_the_link_comes_up_again_whatever_happened(
    steps: list[tuple[str, object]], seed: int, keys: dict[int, bytes] | None
) -> None:
    world = World(PAIR, seed=seed, keys=keys)
    for count, (kind, value) in enumerate(steps):
        if kind != "publish":
            suffer(world, kind, value)
        elif value in world.bots:
            world.publish(value, SYNC_KEY.format(value), count.to_bytes(2, "big"))
    recover(world)
    world.run(12.0)  # the longest cut or stop is over
    world.run(RECOVERY)
    assert world.all_up()
    for sender, receiver in (("r0", "r1"), ("r1", "r0")):
        inbox = world.bots[receiver].inbox
        numbers = [payload for _, payload in inbox]
        assert numbers == sorted(set(numbers)), "each message at most once and in order"
        assert all(key == SYNC_KEY.format(sender) for key, _ in inbox)
        world.publish(sender, SYNC_KEY.format(sender), b"\xff\xff")
        world.run(0.1)
        assert world.bots[receiver].inbox[-1] == (SYNC_KEY.format(sender), b"\xff\xff")


@given(st.integers(1, 250), st.sampled_from((None, KEYS)))
def test_loss_at_any_byte_of_the_handshake(count: int, keys: dict[int, bytes] | None) -> None:
    world = World(PAIR, keys=keys)
    world.break_after = count
    world.run(RECOVERY)
    assert world.all_up()


@given(st.binary(max_size=400), st.integers(0, 2))
def test_noise_never_harms_other_links(noise: bytes, stage: int) -> None:
    world = World([("r0", "r1"), ("r1", "r2")])
    world.run(1.0)
    opening = (hello(), frames.encode_confirm())[:stage]
    world.connect_raw("r1", *opening, noise)
    world.run(1.0)
    assert world.link("r1", "r2").state == "up"
    assert world.link("r1", "r2").connection == 1
