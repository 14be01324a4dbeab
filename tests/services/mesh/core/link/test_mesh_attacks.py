"""Strangers without the key, and changes of the key, under virtual time: each call is refused and counted."""

import pytest
from attacked_links import HANDSHAKE_TIMEOUT, KEY_ID, KEYS, LINE, RECOVERY, SECRET, Watched, hello, watched
from mesh_world import End, World

from services.mesh.core.wire import frames

__all__ = ["watched"]

OTHER = {KEY_ID: bytes(32)}
"""Another key under the same id."""


@pytest.mark.parametrize(
    ("written", "counter", "reason"),
    [
        (hello(insecure=True, key_ids=()), "refused_security", "it is insecure and we are not"),
        (hello(key_ids=()), "refused_key", "robot r0 has another key: none, ours is 00000007"),
        (hello(key_ids=(8, 9)), "refused_key", "robot r0 has another key: 00000009 00000008, ours is 00000007"),
        (hello() + frames.encode_confirm(bytes(32)), "refused_key", "who calls itself r0 does not hold the key"),
        (hello() + frames.encode_confirm(), "bad_frames", "CONFIRM of 0 bytes: it has 32 here"),
        (hello() + frames.encode_data(1, 0, b"x"), "bad_frames", "frame kind 6 before CONFIRM"),
        (hello(robot="r9"), "refused_robot", "robot r9 is not in our configuration"),
        (hello(network="other"), "refused_network", "network 'other'"),
        (hello(versions=(4, 5)), "refused_version", "speaks protocol versions 4 to 5"),
        (b"\xff\xff" + bytes(100), "bad_frames", "frame length 65535: 1 to 256"),
        (hello() + b"\xff\xff" + bytes(100), "bad_frames", "frame length 65535: 1 to 256"),
        (hello(), "silent", "no handshake within 8 s"),
    ],
)
def test_without_the_key_nobody_gets_in(watched: Watched, written: bytes, counter: str, reason: str) -> None:
    for _ in range(3):
        caller = watched.world.connect_raw("r1", written)
        watched.run(HANDSHAKE_TIMEOUT + 0.2)
        assert not caller.open
    assert watched.world.bots["r1"].counters[counter] == 3
    assert len(watched.warnings()) == 1
    assert reason in watched.warnings()[0]
    assert watched.world.link("r1", "r0").connection == 1
    assert watched.world.link("r1", "r0").state == "up"


def test_a_robot_with_another_key_is_refused_by_both_ends_and_backs_off(watched: Watched) -> None:
    world = watched.world
    world.kill("r0")
    world.overrides["r0"] = {"keys": OTHER}
    world.dials.clear()
    world.start("r0")
    watched.run(60.0)
    assert world.link("r0", "r1").connection == 0
    # Whose CONFIRM comes first finds out; the other end reads its BYE.
    refused = [world.bots[name].counters["refused_key"] for name in ("r0", "r1")]
    assert sum(refused) >= 12
    assert max(refused) <= len(world.dials) <= 30
    assert len(watched.warnings()) <= 1
    assert "another key" in world.link("r0", "r1").reason or "does not hold the key" in world.link("r0", "r1").reason
    world.kill("r0")
    world.overrides.clear()
    world.start("r0")
    watched.run(RECOVERY)
    assert world.all_up()


@pytest.mark.parametrize("insecure", ["r0", "r1"])
def test_secure_and_insecure_robots_never_mix(insecure: str) -> None:
    world = World([("r0", "r1")], keys=KEYS)
    world.kill(insecure)
    world.overrides[insecure] = {"insecure": True, "keys": {}}
    world.start(insecure)
    world.run(10.0)
    assert all(world.link(name, peer).connection == 0 for name, peer in (("r0", "r1"), ("r1", "r0")))
    assert sum(bot.counters["refused_security"] for bot in world.bots.values()) >= 2


def test_a_robot_without_any_key_is_refused(watched: Watched) -> None:
    watched.world.kill("r0")
    watched.world.overrides["r0"] = {"keys": {}}
    watched.world.start("r0")
    watched.run(5.0)
    assert watched.world.link("r0", "r1").connection == 0
    assert watched.world.bots["r1"].counters["refused_key"] >= 2


def test_keys_are_replaced_one_robot_at_a_time_without_losing_a_link() -> None:
    world = World(LINE, keys={1: SECRET})
    world.run(1.0)
    for keys in ({2: bytes(32), 1: SECRET}, {2: bytes(32)}):
        for robot in ("r1", "r0", "r2"):
            world.kill(robot)
            world.overrides[robot] = {"keys": keys}
            world.start(robot)
            world.run(RECOVERY)
            assert world.all_up()
    assert sum(bot.counters["refused_key"] for bot in world.bots.values()) == 0
    world.kill("r0")
    world.overrides["r0"] = {"keys": {1: SECRET}}
    world.start("r0")
    world.run(RECOVERY)
    assert world.link("r0", "r1").connection == 0


def test_nobody_between_can_make_two_robots_use_the_older_key() -> None:
    old, new = {1: SECRET}, {2: bytes(32)}
    world = World([("r0", "r1")], keys=new | old)
    of_r0 = world.bots["r0"].node

    def without_the_new(end: End, data: bytes) -> bytes:
        return data.replace(b"\x02\0\0\0\x01\0\0\0\x03lab", b"\x01\0\0\0\x01\0\0\0\x03lab")

    world.tap = without_the_new
    world.run(20.0)
    assert world.bots["r0"].node is of_r0
    assert world.link("r0", "r1").connection == 0
    assert world.bots["r0"].counters["refused_key"] + world.bots["r1"].counters["refused_key"] >= 4
    world.tap = None
    world.run(RECOVERY)
    assert world.all_up()
