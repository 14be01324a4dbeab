"""Real robots on the page: one through a real ssh server, the others over real meshes; and what can go wrong."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
from conftest import Processes, wait_until
from needs import needs_ssh
from remote_swarm import Swarm

from laptop.fleet.ssh.ssh import HostError
from laptop.view.feeds.picture import REACH
from laptop.view.feeds.robots import Robots
from swarm.errors import LocalError
from swarm.messages import Leds, Pose, Stop, read

pytestmark = needs_ssh

RED = Leds(1.0, red=True, yellow=False, green=False)


@pytest.fixture
def swarm(processes: Processes, tmp_path: Path) -> Iterator[Swarm]:
    swarm = Swarm(processes, tmp_path)
    yield swarm
    swarm.close()


def newest(view: Robots, robot: str, topic: str) -> Any:
    with view.lock:
        return view.picture.newest(robot, topic)


def reach(view: Robots, robot: str) -> Any:
    return (newest(view, robot, REACH) or {}).get("by")


def why(view: Robots, robot: str) -> str:
    return str((newest(view, robot, REACH) or {}).get("why"))


def events(view: Robots) -> list[str]:
    with view.lock:
        return [f"{event.robot} {event.text}" for event in view.picture.events]


@pytest.mark.slow
def test_one_robot_shows_all_of_them(swarm: Swarm) -> None:
    for name in ("r0", "r1", "r2"):
        swarm.add(name, ssh=name == "r0")
    swarm.start_meshes()
    view = swarm.view("r0")
    pose = Pose(1.0, 7, 1.25, 2.5, 0.5, 80, "ekf", 0.05, 0.06, 0.1, 0.02)

    def all_seen() -> bool:
        swarm.buses["r2"].publish("swarm/r2/dwm/pose", pose)
        return newest(view, "r2", "dwm/pose") is not None and {reach(view, name) for name in ("r1", "r2")} == {"mesh"}

    wait_until(all_seen, what="r2 is seen two links away")
    assert newest(view, "r2", "dwm/pose")["x"] == 1.25
    assert "raw_x" not in newest(view, "r2", "dwm/pose")
    wait_until(lambda: reach(view, "r0") == "ssh")
    wait_until(lambda: newest(view, "r1", "mesh/links"))
    assert [link["peer"] for link in newest(view, "r1", "mesh/links")["links"]] == ["r0", "r2"]
    wait_until(lambda: view.picture.services().get("r2") == {"mesh": True})

    # A stop goes out on the one bus, and all say that they have obeyed; so it is taken back.
    control = swarm.control(view)
    control.do({"act": "stop"})
    wait_until(lambda: all((newest(view, name, "mesh/stopped") or {}).get("stopped") for name in view.config.names))
    control.repeat()
    control.do({"act": "arm"})
    wait_until(lambda: not any(newest(view, name, "mesh/stopped")["stopped"] for name in view.config.names))
    for act in ("press", "push", "lay"):
        with pytest.raises(LocalError, match="expected an act of stop, arm, set, mode, drive, start, end, kill, cut"):
            control.do({"act": act, "robot": "r0"})
    with pytest.raises(LocalError, match="no robot 'r9'"):
        control.do({"act": "set", "robot": "r9", "app": "x", "name": "gain", "value": 1})

    # One goes in mid-view.
    swarm.meshes["r2"].kill()
    wait_until(lambda: reach(view, "r2") is None, what="r2 is out of reach")
    assert "r2 out of reach: the mesh has lost it" in events(view)
    assert reach(view, "r1") == "mesh"


def test_what_breaks_is_said_and_mended_and_nothing_stays_behind(swarm: Swarm) -> None:
    swarm.add("r0")
    view = swarm.view("r0")

    def seen_again() -> bool:
        swarm.buses["r0"].publish("swarm/r0/balancer/leds", RED)
        return reach(view, "r0") == "ssh"

    wait_until(seen_again)
    swarm.stop_bus("r0")
    wait_until(lambda: "no bus" in why(view, "r0"), what="it is said that the bus is gone")
    swarm.start_bus("r0")
    wait_until(seen_again, what="it is seen again")

    os.kill(swarm.lookout("r0"), signal.SIGKILL)
    wait_until(lambda: reach(view, "r0") is None, what="it is out of reach")
    assert any(text.startswith("r0 out of reach") for text in events(view))
    wait_until(seen_again, what="it is seen again")

    heard: list[object] = []
    swarm.buses["r0"].subscribe("swarm/stop", lambda key, payload: heard.append(read(key, payload)))
    control = swarm.control(view)
    control.do({"act": "stop"})
    # As the server does: nobody has confirmed it, and the subscription is younger than the first one.
    wait_until(lambda: heard or control.repeat(), what="the stop is on the robot's bus")
    assert isinstance(heard[0], Stop)
    pid = swarm.lookout("r0")
    view.close()
    wait_until(lambda: not Path(f"/proc/{pid}/cwd").exists(), what="its lookout has ended")


def test_what_is_wrong_at_first_is_said(swarm: Swarm) -> None:
    swarm.add("r0", known=False)
    swarm.add("r1", ssh=False)
    with pytest.raises(HostError, match="r0: its host key has changed; if set up anew: ssh-keygen -"):
        swarm.view("r0")
    with pytest.raises(HostError, match="r1: it runs no ssh server"):
        swarm.view("r1")
    with pytest.raises(LocalError, match="r9 is no robot of"):
        swarm.view("r9")
    # Several at once: what each of them says is said.
    said = {
        "r2": ("echo 'sudo: a password is required' >&2; exit 1", "its user may not use sudo without a password"),
        "r3": ("echo 'No module named swarm.onboard.lookout' >&2; exit 1", "its release is older than this program"),
        "r4": ("echo garbage", "it says what this program does not understand"),
        "r5": ("true", "its lookout has ended"),
    }
    for name, (text, _) in said.items():
        swarm.add(name, bus=False)
        swarm.far.script(name, "sudo", text)
    with pytest.raises(HostError) as refused:
        swarm.view(*said)
    for name, (_, words) in said.items():
        assert f"{name}: {words}" in str(refused.value)
