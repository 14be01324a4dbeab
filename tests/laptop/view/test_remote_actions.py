"""What a page does to real robots: apps start and stop, services die, links are cut, over real ssh servers. What the
robots' buses say is put in by the test."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import wait_until
from needs import needs_ssh
from remote_units import SUDO, scripts
from test_reach import Tunnel

from bench.rigs.fake_robots import FakeRobots
from laptop.fleet.ssh.ssh import Ssh, hosts
from laptop.view.actions import remote_actions as module
from laptop.view.actions.control import Control
from laptop.view.actions.remote_actions import RemoteActions
from laptop.view.feeds import robots as robots_module
from laptop.view.feeds.robots import Robots
from swarm.config import load
from swarm.errors import LocalError
from swarm.messages import HoldLink

pytestmark = needs_ssh

START = "restart --no-block swarm-app@consensus.service"


class Far:
    """Robots that are ssh servers, and a page's view of them."""

    def __init__(self, folder: Path) -> None:
        self.robots = FakeRobots(folder)
        self.view: Robots
        self.actions: RemoteActions

    def add(self, name: str, *, release: str = "1-a", **options: Any) -> None:
        home = self.robots.add(name, **options)
        for folder in ("active", "etc/apps", "lib/apps"):
            (home / folder).mkdir(parents=True)
        for program, text in scripts(home, self.robots.config, release).items():
            self.robots.script(name, program, text)

    def begin(self, *names: str) -> None:
        """Look at these over ssh, at the others not at all."""
        self.robots.ready()
        config, ssh = load(self.robots.config), Ssh(self.robots.ssh_config)
        self.view = Robots(config, hosts(config, names), ssh)
        for tunnel in self.view.buses.values():
            tunnel.take(["bus", True])
        self.actions = RemoteActions(self.view, ssh)

    def do(self, act: str, **asked: object) -> str:
        return self.actions.acts[act](asked)

    def told(self, text: str, count: int = 1) -> None:
        """Wait until it is among the events."""

        def told() -> bool:
            return sum(text in each for each in self.events()) >= count

        wait_until(told, what=lambda: f"{text!r} is told {count} times; told is {self.events()}")

    def events(self) -> list[str]:
        with self.view.lock:
            return [f"{event.robot} {event.text}" for event in self.view.picture.events]

    def log(self, name: str) -> list[str]:
        path = self.robots.folder / name / "systemctl.log"
        return path.read_text().splitlines() if path.exists() else []

    def settings(self, name: str) -> str:
        return (self.robots.folder / name / "etc/apps/consensus.env").read_text()

    def close(self) -> None:
        self.actions.close()
        self.view.close()
        self.robots.close()


@pytest.fixture
def far(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Far]:
    monkeypatch.setattr(robots_module, "Tunnel", Tunnel)
    monkeypatch.setattr(robots_module, "SILENT_S", 1e9)
    monkeypatch.setattr(module, "COMPARE_S", 1e3)
    far = Far(tmp_path)
    yield far
    far.close()


def test_an_app_begins_goes_on_and_ends_and_who_is_absent_is_named(far: Far) -> None:
    far.add("r0")
    far.add("r1")
    far.add("r2", up=False)
    far.begin("r0")
    assert far.do("start", app="consensus").startswith("consensus: to be started on r0 r1 r2")
    far.told("r2 app/consensus was not started: it runs no ssh server (or another port)")
    far.told("app/consensus was started", 2)
    assert [far.log(name) for name in ("r0", "r1")] == [[START], [START]]
    assert far.settings("r0") == far.settings("r1")
    assert "APP=consensus\nARGUMENTS=--run " in far.settings("r0")
    assert "--record" in far.settings("r0")
    with far.view.lock:
        assert far.view.picture.newest("r1", module.APPS) == {"apps": ["consensus"]}

    far.do("end", app="consensus")
    far.told("app/consensus was stopped", 2)
    far.told("r2 app/consensus was not stopped: it runs no ssh server")
    before = far.settings("r1")
    far.do("start", app="consensus", robot="r1")
    far.told("r1 app/consensus was started: it goes on where it was")
    assert far.settings("r1") == before
    assert far.log("r1") == [START, "stop swarm-app@consensus.service", "start --no-block swarm-app@consensus.service"]
    assert len(far.log("r0")) == 2


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ("release", "different releases (r0 1-a, r1 1-b): swarm deploy the same to all of them"),
        ("config", "another swarm.toml than here (r1): swarm deploy brings this one"),
        ("firmware", "different firmware (r0 revision 1 (layout 1), r1 revision 2 (layout 1)): swarm flash the same"),
    ],
)
def test_robots_that_differ_run_nothing_and_are_named(far: Far, odd: str, said: str) -> None:
    far.add("r0")
    far.add("r1", release="1-b" if odd == "release" else "1-a")
    if odd == "config":
        far.robots.script("r1", "sha256sum", f"echo {'0' * 64}")
    if odd == "firmware":
        text = SUDO.format(runtime="", python="").replace('"revision": 1', '"revision": 2')
        far.robots.script("r1", "sudo", text)
    far.begin("r0", "r1")
    wait_until(lambda: far.actions._is_seen("r0") and far.actions._is_seen("r1"))
    far.do("start", app="consensus")
    far.told("app/consensus was not started: ", 2)
    assert sum(said in text for text in far.events()) == 1
    assert sum(text.endswith(("see r0", "see r1")) for text in far.events()) == 1
    assert far.log("r0") == far.log("r1") == []


@pytest.mark.slow
def test_who_hangs_delays_nobody_and_a_newer_order_holds(far: Far, monkeypatch: pytest.MonkeyPatch) -> None:
    far.add("r0")
    far.add("r1", hook="[ ! -e $HOME/hangs ] || { echo $$ >>$HOME/hung; exec sleep 1000; }")
    far.begin("r0")
    (far.robots.folder / "r1/hangs").touch()
    far.do("start", app="consensus")
    far.told("r0 app/consensus was started")
    # It would be started late: it has been stopped meanwhile.
    wait_until((far.robots.folder / "r1/hung").exists)
    monkeypatch.setattr(module, "TIMEOUT_S", 1.0)
    far.do("end", app="consensus", robot="r1")
    far.told("r1 app/consensus was not stopped within 1 s")
    assert far.log("r1") == []


@pytest.mark.slow
def test_the_older_of_two_orders_is_left_out(far: Far) -> None:
    """The start takes its time to compare the robots, the stop does not."""
    asks = "case $SSH_ORIGINAL_COMMAND in *release*) ;; *) false ;; esac"
    far.add("r0", hook=f"while [ -e $HOME/slow ] && {asks}; do sleep .05; done")
    far.begin("r0")
    (far.robots.folder / "r0/slow").touch()
    far.do("start", app="consensus")
    far.do("end", app="consensus")
    far.told("r0 app/consensus was stopped")
    (far.robots.folder / "r0/slow").unlink()
    far.told("r0 app/consensus was not started: another order has come after this one")
    assert far.log("r0") == ["stop swarm-app@consensus.service"]


@pytest.mark.slow
def test_robots_without_a_run_in_common_begin_a_new_one_if_it_comes_with_the_release(far: Far) -> None:
    for name in ("r0", "r1"):
        far.add(name)
    (far.robots.folder / "r0/etc/apps/consensus.env").write_text("APP=consensus\nARGUMENTS=--run 1\n")
    (far.robots.folder / "r0/etc/apps/mine.env").write_text(
        "APP=/var/lib/swarm/apps/mine-0/mine.py\nARGUMENTS=--run 1\n"
    )
    far.begin("r0", "r1")

    def known() -> object:
        with far.view.lock:
            return far.view.picture.newest("r0", module.APPS)

    wait_until(lambda: known() == {"apps": ["consensus", "mine"]}, what="apps of before are known")
    wait_until(lambda: far.actions._is_seen("r0") and far.actions._is_seen("r1"))
    far.do("start", app="consensus")
    far.told("app/consensus was started", 2)
    assert far.settings("r0") == far.settings("r1") != "APP=consensus\nARGUMENTS=--run 1\n"
    far.do("start", app="mine")
    far.told("was not started: it is a file of yours, which not all robots have in the same run (r0 have one)", 2)
    far.do("start", app="flood", robot="r1")
    far.told("r1 app/flood was not started: it has not run it yet: start it on all robots")


@pytest.mark.slow
def test_an_app_that_does_not_come_is_named(far: Far, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SEEN_S", 0.1)
    far.add("r0")
    far.begin("r0")
    far.do("start", app="nothing")
    far.told("r0 app/nothing is not seen 0.1 s after its start: swarm logs nothing --robots r0")


def test_a_service_is_killed_where_it_runs(far: Far) -> None:
    far.add("r0")
    far.add("r1")
    far.begin("r0")
    (far.robots.folder / "r1/active/swarm-dwm.service").touch()
    assert far.do("kill", robot="r1", service="dwm") == "r1: dwm is to be killed"
    far.told("r1 dwm was killed")
    assert far.log("r1") == ["kill --kill-whom=main --signal=KILL swarm-dwm.service"]
    far.do("kill", robot="r1", service="app/consensus")
    far.told("r1 app/consensus was not killed: it is not running at this moment")
    for service in ("consensus", "app/mesh", "../x", "app/a b"):
        with pytest.raises(LocalError):
            far.do("kill", robot="r1", service=service)


def last_sent(far: Far, what: str) -> tuple[str, Any]:
    """Key and message of the last command of that kind to r0; what the view asks for by itself goes the same way."""
    return [each for each in far.view.buses["r0"].published if each[0].endswith(what)][-1]


def test_parameters_go_over_ssh_where_no_bus_is_near(far: Far) -> None:
    far.add("r0")
    far.add("r1")
    far.add("r2", up=False)
    far.begin("r0")
    control = Control(far.view, far.actions)
    asked = {"act": "set", "app": "consensus", "name": "gain", "value": 0.5}
    assert control.do(asked) == "consensus: gain=0.5 asked of r0 r1 r2"
    far.told("r1 app/consensus: gain=0.5")
    far.told("r2 app/consensus: gain=0.5 was not set: it runs no ssh server")
    key, message = last_sent(far, "/set/parameters")
    assert (key, message.parameters) == ("swarm/r0/app/consensus/set/parameters", {"gain": 0.5})
    control.do(asked | {"robot": "r1", "name": "on", "value": True})
    far.told("r1 app/consensus: on=true")
    control.do(asked | {"robot": "r1", "value": 9})
    far.told("r1 app/consensus: gain=9 was not set: app consensus: expected a number up to 1, got 9")
    log = [(far.robots.folder / name / "swarm.log") for name in ("r0", "r1")]
    assert not log[0].exists()
    words = ("gain=0.5", "on=true", "gain=9")
    assert log[1].read_text().splitlines() == [f"app param consensus {word}" for word in words]
    for bad in ({"robot": "r9"}, {"name": "r1.gain"}, {"name": "--fleet"}):
        with pytest.raises(LocalError):
            control.do(asked | bad)


def show_link(far: Far, state: str) -> None:
    """Let r0 tell its link with r1."""
    with far.view.lock:
        far.view.picture.put("r0", "mesh/links", {"links": [{"peer": "r1", "state": state}]}, 0.0)


def test_a_link_that_stays_up_is_named_and_who_cannot_be_told(far: Far, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CUT_S", 0.1)
    monkeypatch.setattr(module, "MEND_S", 0.1)
    far.add("r0")
    far.add("r1", up=False)
    far.begin("r0")
    show_link(far, "up")
    assert far.do("cut", robot="r1", peer="r0", seconds=60) == "r1 - r0: to be cut for 60 s"
    far.told("r1 the link to r0 is still up: is the release of its mesh older than this program?")
    published = far.view.buses["r0"].published
    assert ("swarm/r0/mesh/set/hold", HoldLink("r1", 60.0)) in published
    show_link(far, "down")
    assert far.do("cut", robot="r0", peer="r1", seconds=0) == "r0 - r1: to be mended"
    far.told("r1 it cannot be told to mend the link r0 - r1: it runs no ssh server")
    far.told("r0 the link to r1 is still down")
    assert last_sent(far, "/set/hold") == ("swarm/r0/mesh/set/hold", HoldLink("r1", 0.0))
    far.view.buses["r0"].lose("gone")
    far.do("cut", robot="r0", peer="r1", seconds=60)
    far.told("r1 it cannot be told to cut the link r0 - r1: it runs no ssh server")
    assert last_sent(far, "/set/hold") == ("swarm/r0/mesh/set/hold", HoldLink("r1", 0.0))


def test_a_cut_that_a_bus_has_lost_is_told_again_until_it_is_in_force(
    far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "AGAIN_S", 0.0)
    monkeypatch.setattr(module, "_LOOK_EVERY_S", 0.01)
    monkeypatch.setattr(module, "CUT_S", 1e3)
    far.add("r0")
    far.add("r1", up=False)
    far.begin("r0")
    published = far.view.buses["r0"].published
    order = ("swarm/r0/mesh/set/hold", HoldLink("r1", 60.0))
    show_link(far, "up")
    far.do("cut", robot="r0", peer="r1", seconds=60)
    wait_until(lambda: published.count(order) >= 3)
    show_link(far, "down")
    wait_until(lambda: not far.actions._tasks)
    count = published.count(order)
    far.do("cut", robot="r0", peer="r1", seconds=0)
    wait_until(lambda: published.count(("swarm/r0/mesh/set/hold", HoldLink("r1", 0.0))) >= 3)
    assert published.count(order) == count


def test_bad_orders_reach_no_robot(far: Far) -> None:
    far.add("r0")
    far.add("r1")
    far.begin("r0")
    for act, said in (
        ({"act": "start", "app": "../x"}, "name of an app"),
        ({"act": "start", "app": "mesh"}, "name of an app"),
        ({"act": "end", "app": "x; reboot"}, "name of an app"),
        ({"act": "start", "app": "x", "robot": "r9"}, "no robot 'r9'"),
        ({"act": "kill", "robot": "r9", "service": "mesh"}, "no robot"),
        ({"act": "cut", "robot": "r0", "peer": "r9", "seconds": 1}, "no robot"),
        ({"act": "cut", "robot": "r0", "peer": "r1", "seconds": 1e9}, "600"),
        ({"act": "cut", "robot": "r0", "peer": "r1", "seconds": float("nan")}, "600"),
    ):
        with pytest.raises(LocalError, match=said):
            far.actions.acts[act["act"]](act)
    assert far.log("r0") == far.log("r1") == []


def test_an_end_in_mid_order_leaves_nothing_here(far: Far) -> None:
    far.add("r0", hook="[ ! -e $HOME/hangs ] || { echo $$ >>$HOME/hung; exec sleep 1000; }")
    far.begin("r0")
    (far.robots.folder / "r0/hangs").touch()
    far.do("start", app="consensus")
    wait_until((far.robots.folder / "r0/hung").exists)
