"""How real robots are seen: by ssh, over the mesh or not at all, whatever they say; without any network."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from conftest import wait_until
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from laptop.fleet.ssh.ssh import Host, Ssh
from laptop.view.actions.control import Control
from laptop.view.actions.robot_actions import PageAction
from laptop.view.feeds import robots as module
from laptop.view.feeds.picture import REACH
from laptop.view.feeds.robots import Robots
from swarm import clock
from swarm.config import parse
from swarm.errors import LocalError
from swarm.messages import Leds, Member, Members, Pose, Stopped, View, Watch
from swarm.messages.codec import Value, encode

CONFIG = 'network = "x"\n[topology]\nshape = "line"\n[mesh]\ninsecure = true\n' + "".join(
    f'[[robots]]\nname = "r{n}"\nlink = "tcp:127.0.0.1:{9000 + n}"\n' for n in range(3)
)
LEDS = encode(Leds(1.0, red=True, yellow=False, green=False))
POSE = encode(Pose(1.0, 7, 1.25, 2.5, 0.5, 80, "ekf"))


class Tunnel:
    """What a robot says is put in by the test."""

    def __init__(self, ssh: Ssh, host: Host, take: Callable[[list[Any]], None], changed: Callable[[], None]) -> None:
        self.host, self.take, self.changed = host, take, changed
        self.connected, self.problem = True, ""
        self.published: list[tuple[str, object]] = []

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        self.published.append((key, message))

    def lose(self, problem: str) -> None:
        self.connected, self.problem = False, problem
        self.changed()

    def close(self) -> None:
        pass


class Nothing:
    """Hands that lie still."""

    acts: Mapping[str, PageAction] = {}

    def give(self, robots: Sequence[str], app: str, values: Mapping[str, Value]) -> list[str]:
        return list(robots)

    def close(self) -> None:
        pass


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch) -> Iterator[Robots]:
    monkeypatch.setattr(module, "Tunnel", Tunnel)
    monkeypatch.setattr(module, "GRACE_S", 0.0)
    view = Robots(parse(CONFIG, Path("swarm.toml")), [Host("r0", "r0"), Host("r1", "r1")], Ssh())
    yield view
    view.close()


def reach(view: Robots, robot: str) -> tuple[Any, Any]:
    with view.lock:
        value = view.picture.newest(robot, REACH) or {}
    return value.get("by"), value.get("why")


def test_by_ssh_over_the_mesh_or_not_at_all(view: Robots) -> None:
    r0, r1 = view.buses["r0"], view.buses["r1"]
    r0.take(["bus", True])
    r0.take(["key", "swarm/r0/balancer/leds", LEDS])
    wait_until(lambda: reach(view, "r0") == ("ssh", ""))
    wait_until(lambda: reach(view, "r2") == (None, "the mesh brings nothing of it"))
    told = View(1.0, {"mesh": "ready", "dwm": "degraded: no anchors", "balancer": "gone"}, {"dwm/pose": POSE})
    r0.take(["key", "swarm/r2/mesh/view", encode(told)])
    wait_until(lambda: reach(view, "r2") == ("mesh", ""))
    with view.lock:
        assert view.picture.newest("r2", "dwm/pose")["x"] == 1.25
        assert view.picture.services()["r2"] == {"mesh": True, "dwm": True, "balancer": False}
        assert view.picture.newest("r2", "dwm/status") == {"state": "degraded", "reason": "no anchors"}
    members = Members(1.0, (Member("r2", "left", 1.0, None, None),), ())
    r0.take(["key", "swarm/r0/mesh/members", encode(members)])
    wait_until(lambda: reach(view, "r2") == (None, "its mesh was stopped"))

    r0.lose("it went away in the middle of it")
    wait_until(lambda: reach(view, "r0") == (None, "it went away in the middle of it"))
    assert view.live
    r1.take(["key", "swarm/r0/mesh/view", encode(told)])
    wait_until(lambda: reach(view, "r0") == ("mesh", "it went away in the middle of it"))
    r1.lose("it runs no ssh server (or another port)")
    wait_until(lambda: reach(view, "r2")[0] is None)
    assert not view.live
    with pytest.raises(LocalError, match="swarm estop"):
        Control(view, Nothing()).do({"act": "stop"})


def test_the_others_are_asked_through_one_robot_only(view: Robots) -> None:
    r0, r1 = view.buses["r0"], view.buses["r1"]
    wait_until(lambda: r0.published)
    key, message = r0.published[0]
    assert key == "swarm/r0/mesh/set/watch"
    assert isinstance(message, Watch)
    assert not r1.published
    r0.lose("gone")
    wait_until(lambda: r1.published)


def test_another_robot_at_a_host_is_named(view: Robots) -> None:
    view.buses["r0"].take(["bus", True])
    view.buses["r0"].take(["alive", "swarm/r2/mesh/alive", True])
    wait_until(lambda: reach(view, "r0")[0] is None)
    assert "that host is r2" in reach(view, "r0")[1]


def test_messages_between_robots_are_counted(view: Robots) -> None:
    view.buses["r0"].take(["passed", "r1", 7])
    assert view.picture.hops() == {"r1>r0": 7}


def test_a_stop_is_confirmed_by_a_robots_own_bus_where_that_is_heard(view: Robots) -> None:
    """Whatever a captured robot says of the other one."""
    r0, r1 = view.buses["r0"], view.buses["r1"]
    control = Control(view, Nothing())
    control.do({"act": "stop"})
    told = Stopped(1.0, True, {"r0": "x"})
    for name in ("r0", "r1", "r2"):
        r0.take(["key", f"swarm/{name}/mesh/stopped", encode(told)])
    r0.take(["key", "swarm/r1/mesh/view", encode(View(1.0, {}, {"mesh/stopped": encode(told)}))])
    control.repeat()
    assert [key for key, _ in r1.published].count("swarm/stop") == 2
    assert [key for key, _ in r0.published].count("swarm/stop") == 1
    with view.lock:
        assert view.picture.newest("r2", "mesh/stopped") is not None
    r1.take(["key", "swarm/r1/mesh/stopped", encode(told)])
    control.repeat()
    assert [key for key, _ in r1.published].count("swarm/stop") == 2


SAID = st.lists(
    st.none() | st.booleans() | st.integers() | st.floats() | st.binary(max_size=20) | st.text(max_size=20)
    | st.sampled_from(["bus", "key", "alive", "passed", "swarm/r2/mesh/view", "swarm/r0/mesh/members", LEDS, POSE]),
    min_size=1, max_size=4,
)  # fmt: skip


@given(st.lists(SAID, max_size=10))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_nothing_that_a_robot_says_harms_the_page(view: Robots, said: list[list[Any]]) -> None:
    for each in said:
        view.buses["r0"].take(each)
    now = clock.now()
    for name in view.config.names:
        view._reach(name, now)
