"""The connection to a robot: whatever messages come through it, it stays, and a stop goes through it."""

import io
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
from conftest import wait_until
from test_reach import CONFIG, LEDS, Nothing

from laptop.fleet.ssh.ssh import Host
from laptop.view.actions.control import Control
from laptop.view.feeds.picture import REACH
from laptop.view.feeds.robots import Robots
from laptop.view.feeds.tunnel import _GARBAGE, Tunnel
from swarm import clock
from swarm.config import parse
from swarm.messages import Arm, View
from swarm.messages.codec import encode

LOOKOUT = """
import os, sys
data = open(sys.argv[1], "rb").read()
while data:
    data = data[os.write(1, data):]
while data := os.read(0, 4096):
    with open(sys.argv[2], "ab") as file:
        file.write(data)
"""


class Ssh:
    """In place of ssh, a program that says what the test has written down, and notes what it is told."""

    def __init__(self, folder: Path, said: bytes) -> None:
        self.said, self.told = folder / "said", folder / "told"
        self.said.write_bytes(said)

    def arguments(self, host: Host, command: str) -> list[str]:
        return [sys.executable, "-c", LOOKOUT, str(self.said), str(self.told)]


def messages(*said: object) -> bytes:
    return b"".join(msgpack.packb(each) for each in said)


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[Callable[[bytes], tuple[Robots, Ssh]]]:
    """A view of robots through r0, which says this."""
    views: list[Robots] = []

    def begin(said: bytes) -> tuple[Robots, Ssh]:
        ssh: Any = Ssh(tmp_path, said)
        views.append(Robots(parse(CONFIG, tmp_path / "swarm.toml"), [Host("r0", "r0")], ssh))
        return views[-1], ssh

    yield begin
    for view in views:
        view.close()


ODD = [
    5,
    None,
    [],
    {"links": 5},
    {"links": [5]},
    {"links": [{"peer": {}}]},
    {"members": 5},
    {"members": [[1]]},
    {"stopped": {}},
]


def test_odd_messages_of_other_robots_leave_the_connection_and_are_named(
    watch: Callable[[bytes], tuple[Robots, Ssh]],
) -> None:
    """Each of them is a member that was captured."""
    odd = [
        ["key", f"swarm/r1/{topic}", msgpack.packb(value)]
        for topic in ("mesh/links", "mesh/members", "mesh/stopped", "mesh/status", "app/x/progress", "balancer/fault")
        for value in ODD
    ]
    for value in ODD:
        values = {topic: msgpack.packb(value) for topic in ("mesh/links", "app/x/progress", "balancer/fault", "../..")}
        odd.append(["key", "swarm/r2/mesh/view", encode(View(1.0, {}, values))])
        odd.append(["key", "swarm/r2/mesh/view", msgpack.packb(value)])
        odd.append(["key", "swarm/r0/mesh/members", msgpack.packb(value)])
    odd.append(["key", "swarm/r2/mesh/view", encode(View(1.0, {"../x": "here", "": "gone"}, {}))])
    odd += [
        ["passed", "r1", "many"],
        ["alive", "x", True],
        ["alive", 5, 5],
        ["key", "x"],
        ["key", 1, 2],
        [{}],
        ["bus", 1],
    ]
    odd += [["passed", f"x{number}", 1] for number in range(100)]
    view, ssh = watch(messages(*odd, ["bus", True], ["key", "swarm/r0/balancer/leds", LEDS]))

    def newest(robot: str, topic: str) -> Any:
        with view.lock:
            return view.picture.newest(robot, topic)

    wait_until(lambda: newest("r0", "balancer/leds"), what="what came behind the odd messages")
    wait_until(lambda: (newest("r0", REACH) or {}).get("by") == "ssh")
    tunnel = view.buses["r0"]
    assert tunnel.connected
    assert tunnel.problem == ""
    assert view._thread.is_alive()
    with view.lock:
        named = {(event.robot, event.text.partition(" ")[0]) for event in view.picture.events}
        assert {("r1", "mesh/links"), ("r1", "balancer/fault"), ("r2", "mesh/links"), ("r2", "mesh/view")} <= named
        assert view.picture.refused >= len(ODD)
        assert view.picture.hops() == {}

    control = Control(view, Nothing())
    control.do({"act": "stop"})
    wait_until(lambda: ssh.told.exists() and b"swarm/stop" in ssh.told.read_bytes())


def test_a_defect_in_taking_a_message_leaves_the_connection(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    taken: list[object] = []

    def take(said: list[object]) -> None:
        taken.append(said)
        raise TypeError("a defect")

    ssh: Any = Ssh(tmp_path, messages(["bus", True], ["bus", False]))
    tunnel = Tunnel(ssh, Host("r0", "r0"), take, lambda: None)
    wait_until(lambda: len(taken) == 2)
    assert tunnel.connected
    tunnel.close()
    assert caplog.text.count("a message that came through r0 could not be taken") == 2


ENDLESS = b"\x9f" + (b"\x9f" + b"\x90" * 15) * 15
"""A list with lists in it, as an entry of a list that does not end."""


@pytest.mark.parametrize("said", [b"\xdc\xff\xff" * 500, b"\x9f" * 900 + ENDLESS * 9000])
def test_a_robot_that_says_endless_lists_is_named_and_heard_no_more(tmp_path: Path, said: bytes) -> None:
    ssh: Any = Ssh(tmp_path, messages(["bus", True]) + said)
    taken: list[list[object]] = []
    tunnel = Tunnel(ssh, Host("r0", "r0"), taken.append, lambda: None)
    wait_until(lambda: tunnel.problem == _GARBAGE)
    tunnel.close()
    assert taken[0] == ["bus", True]


def test_the_end_of_a_stop_goes_with_the_robots_time_or_not_at_all(
    watch: Callable[[bytes], tuple[Robots, Ssh]],
) -> None:
    """A network may hold it up for as long as it likes: the robot must see how old it is."""
    view, ssh = watch(messages(["bus", True]))
    tunnel: Any = view.buses["r0"]
    wait_until(lambda: tunnel.connected)
    tunnel.publish("swarm/r0/mesh/set/arm", Arm(1.0, "r0", 0.5), urgent=True)
    tunnel.publish("swarm/stop", b"first")
    tunnel._clock = 5000.0 - clock.now()
    tunnel.publish("swarm/r0/mesh/set/arm", Arm(1.0, "r0", 0.5), urgent=True)

    def told() -> list[Any]:
        said = msgpack.Unpacker(io.BytesIO(ssh.told.read_bytes())) if ssh.told.exists() else ()
        return [each for each in said if each[0] in ("swarm/r0/mesh/set/arm", "swarm/stop")]

    wait_until(lambda: len(told()) == 2, what="the two that were sent")
    assert told()[0] == ["swarm/stop", b"first"]
    assert told()[1] == ["swarm/r0/mesh/set/arm", encode(Arm(1.0, "r0", 0.5)), pytest.approx(5000.0, abs=5.0)]


def test_a_tunnel_knows_the_clock_of_its_robot(watch: Callable[[bytes], tuple[Robots, Ssh]]) -> None:
    view, _ = watch(messages(["bus", True], ["clock", 100.0], ["clock", 5000.0], ["clock", None]))
    tunnel: Any = view.buses["r0"]
    wait_until(lambda: tunnel._clock is not None and tunnel._clock + clock.now() > 4000.0)
    assert tunnel._clock + clock.now() < 5060.0
