"""Replay, reflection and changed frames under virtual time: each ends its own connection, and no other link notices."""

from collections.abc import Callable

import pytest
from attacked_links import (
    HANDSHAKE_TIMEOUT,
    RECOVERY,
    SYNC,
    Watched,
    bit_flipped,
    byte_missing,
    class_changed,
    endless_length,
    forged_bye,
    hello,
    last_frame_again,
    watched,
)
from mesh_world import End

from services.mesh.core.wire import frames

__all__ = ["watched"]


@pytest.mark.parametrize("writes", [1, 2, 100])
def test_a_recorded_dialler_is_refused(watched: Watched, writes: int) -> None:
    """Its HELLO alone, with its CONFIRM, and all that it ever sent."""
    watched.run(2.0)
    for _ in range(3):
        caller = watched.world.connect_raw("r1", *watched.recorded("r0")[:writes])
        watched.run(HANDSHAKE_TIMEOUT + 0.2)
        assert not caller.open
    counters = watched.world.bots["r1"].counters
    assert counters["silent" if writes == 1 else "refused_key"] == 3
    assert watched.world.link("r1", "r0").connection == 1


def test_a_recorded_listener_is_refused(watched: Watched) -> None:
    """Who answers r0's calls in r1's place with what r1 once said, holds no key."""
    watched.run(1.0)
    record = b"".join(watched.recorded("r1"))
    watched.world.break_connections("r1")  # r2's link, too: it is met again below
    watched.changes = lambda end, data: record if end.robot == "r1" else data
    watched.world.run(10.0)
    assert watched.world.bots["r0"].counters["refused_key"] >= 2
    assert watched.world.link("r0", "r1").connection == 1
    watched.changes = None
    watched.world.run(RECOVERY)
    assert watched.world.all_up()
    watched.check_others = lambda: None  # type: ignore[method-assign]


def test_a_mirror_is_refused(watched: Watched) -> None:
    caller = watched.world.connect_raw("r1")
    watched.run(0.1)
    caller.write(caller.heard)
    watched.run(0.2)
    assert not caller.open
    assert watched.world.bots["r1"].counters["refused_robot"] == 1
    assert "our own name" in watched.warnings()[0]


def test_a_mirrored_confirm_is_refused(watched: Watched) -> None:
    caller = watched.world.connect_raw("r1", hello())
    watched.run(0.1)
    confirm = caller.heard[-35:]
    assert confirm[:3] == b"\x21\0\x02"
    caller.write(confirm)
    watched.run(0.2)
    assert not caller.open
    assert watched.world.bots["r1"].counters["refused_key"] == 1


def tag_flipped(end: End, data: bytes) -> bytes:
    return data[:-1] + bytes((data[-1] ^ 0x80,))


def truncated(end: End, data: bytes) -> bytes:
    return data[:-3]


def without_tag(end: End, data: bytes) -> bytes:
    return frames.encode_heartbeat(frames.Heartbeat(0, 0, 1))


@pytest.mark.parametrize(
    ("change", "counter"),
    [
        (last_frame_again, "bad_tags"),
        (bit_flipped, "bad_tags"),
        (tag_flipped, "bad_tags"),
        (class_changed, "bad_tags"),
        (byte_missing, "bad_tags"),
        (truncated, "bad_tags"),
        (endless_length, "bad_frames"),
        (without_tag, "bad_tags"),
        (forged_bye, "bad_tags"),
    ],
)
def test_a_changed_frame_ends_its_connection_only(
    watched: Watched, change: Callable[[End, bytes], bytes], counter: str
) -> None:
    for _ in range(3):
        done: list[bytes] = []

        def once(end: End, data: bytes, done: list[bytes] = done) -> bytes:
            if end.robot != "r0" or done or watched.world.link("r0", "r1").state != "up":
                return data
            done.append(data)
            return change(end, data)

        watched.changes = once
        watched.run(5.0)
        assert done
    bot = watched.world.bots["r1"]
    assert bot.counters[counter] == 3
    assert sum("connection ended peer=r0" in text for text in watched.warnings()) == 1
    assert bot.counters["byes"] == 0
    assert watched.world.link("r1", "r0").connection == 4
    assert watched.world.all_up()
    assert not [each for each in bot.inbox if each[0] == SYNC.format("r0")]


def test_reflected_frames_end_the_connection(watched: Watched) -> None:
    """A frame of r1 comes back to r1 in place of r0's next one."""
    own = watched.recorded("r1")[-1]
    done: list[bytes] = []

    def reflect(end: End, data: bytes) -> bytes:
        if end.robot == "r0" and not done:
            done.append(data)
            return own
        return data

    watched.changes = reflect
    watched.run(3.0)
    assert watched.world.bots["r1"].counters["bad_tags"] == 1
    assert watched.world.all_up()


def test_a_frame_that_was_kept_back_ends_the_connection(watched: Watched) -> None:
    """Frames cannot be left out: the next one's counter is another."""
    dropped: list[bytes] = []

    def drop(end: End, data: bytes) -> bytes:
        if end.robot == "r0" and not dropped:
            dropped.append(data)
            return b""
        return data

    watched.changes = drop
    watched.run(3.0)
    assert dropped
    assert watched.world.bots["r1"].counters["bad_tags"] == 1


def test_bytes_that_trickle_do_not_keep_a_dead_link_alive(watched: Watched) -> None:
    """Whoever holds back the stream and lets a byte through now and then is silence all the same."""
    kept = bytearray()

    def trickle(end: End, data: bytes) -> bytes:
        if end.robot != "r0":
            return data
        kept.extend(data)
        first = bytes(kept[:1])
        del kept[:1]
        return first

    watched.changes = trickle
    watched.run(4.0)
    assert watched.world.bots["r1"].counters["silent"] == 1
    watched.changes = None
    watched.run(RECOVERY)
    assert watched.world.all_up()
