"""`swarm pair` on robots with a real D-Bus each, and bluetoothds that are played by another D-Bus implementation."""

import asyncio
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fake_robots import SSHD, FakeRobots

from bench.rigs.running import running
from laptop.cli import main
from laptop.fleet.ssh import remote
from laptop.fleet.ssh.ssh import Host, Ssh
from swarm.config import load

PYTHON = "/usr/bin/python3"
"""Debian's own, which has python3-dbus and python3-gi."""


def _has_dbus() -> bool:
    if SSHD is None or shutil.which("ssh") is None or shutil.which("dbus-daemon") is None:
        return False
    return subprocess.run([PYTHON, "-c", "import dbus, gi"], capture_output=True).returncode == 0


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not os.environ.get("CI") and not _has_dbus(),
        reason="needs: apt-get install openssh-server dbus python3-dbus python3-gi",
    ),
]

DAEMON = """<busconfig>
<type>system</type><listen>unix:path={path}</listen><auth>EXTERNAL</auth>
<policy context="default"><allow send_destination="*"/><allow own="*"/><allow eavesdrop="true"/></policy>
</busconfig>
"""


class Air:
    """Robots with bluetoothds."""

    def __init__(self, folder: Path) -> None:
        self.robots = FakeRobots(folder)
        self.folder = folder
        self.log = folder / "air.log"
        self.spec: dict[str, dict[str, object]] = {}
        self._stack = ExitStack()

    def add(self, name: str, **spec: object) -> None:
        path = self.folder / f"{name}.bus"
        self.robots.add(name, hook=f"export DBUS_SYSTEM_BUS_ADDRESS=unix:path={path}")
        config = self.folder / f"{name}.conf"
        config.write_text(DAEMON.format(path=path))
        command = ["dbus-daemon", f"--config-file={config}", "--nofork", "--nopidfile", "--print-address"]
        self._start(command)
        self.spec[name] = {"bus": f"unix:path={path}", "address": f"B8:27:EB:00:00:1{name[1]}", **spec}

    def start(self, config: str) -> None:
        """bluetoothd on all of them; the swarm's config."""
        file = self.folder / "spec.json"
        file.write_text(json.dumps({"robots": self.spec, "log": str(self.log)}))
        self._start([PYTHON, str(Path(__file__).with_name("fake_bluetoothd.py")), str(file)])
        self.robots.config.write_text(config)
        self.robots.ready()

    def _start(self, command: list[str]) -> None:
        process = self._stack.enter_context(running(command, stdout=subprocess.PIPE, text=True))
        assert process.stdout is not None
        assert process.stdout.readline() != "", command

    def said(self) -> list[str]:
        return self.log.read_text().splitlines()

    def close(self) -> None:
        self.robots.close()
        self._stack.close()


@pytest.fixture
def air(tmp_path: Path) -> Iterator[Air]:
    air = Air(tmp_path)
    yield air
    air.close()


Pair = Callable[..., tuple[int, dict[str, str], dict[str, str]]]


@pytest.fixture
def pair(air: Air, capsys: pytest.CaptureFixture[str]) -> Pair:
    """`swarm pair`: exit code, what is said of each link, and of the robots that are not well."""

    def swarm(*arguments: str) -> tuple[int, dict[str, str], dict[str, str]]:
        config = ["--config", str(air.robots.config), "--ssh-config", str(air.robots.ssh_config)]
        with pytest.raises(SystemExit) as end:
            main(["pair", "--json", *arguments, *config])
        out, err = capsys.readouterr()
        assert out, err
        answer = json.loads(out)
        robots = {name: row["text"] for name, row in answer["robots"].items() if not row["ok"]}
        return int(str(end.value.code)), answer["links"], robots

    return swarm


def config(names: str, shape: str = '[topology]\nshape = "full"', addressed: str = "") -> str:
    rows = ""
    for name in names.split():
        rows += f'[[robots]]\nname = "{name}"   # of the lab\n'
        rows += f'bluetooth = "B8:27:EB:00:00:1{name[1]}"\n' if name in addressed.split() else ""
    return f'network = "test"\n{shape}\n{rows}[mesh]\ninsecure = true\n'


def test_all_neighbours_are_paired_and_the_config_gets_their_addresses(air: Air, pair: Pair) -> None:
    for name in ("r0", "r1", "r2"):
        air.add(name)
    air.start(config("r0 r1 r2", addressed="r1"))
    code, links, robots = pair()
    assert (code, robots) == (0, {})
    assert links == {"r0 r1": "paired", "r0 r2": "paired", "r1 r2": "paired"}
    assert sorted(air.said()) == ["r0 calls r1", "r0 calls r2", "r1 calls r2"]
    written = load(air.robots.config)
    assert [robot.bluetooth for robot in written.robots] == [f"B8:27:EB:00:00:1{n}" for n in range(3)]
    assert air.robots.config.read_text() == config("r0 r1 r2", addressed="r0 r1 r2")
    assert pair("--check") == (0, links, {})
    assert pair() == (0, links, {})
    assert len(air.said()) == 3  # what is paired is left alone
    assert pair("--again")[0] == 0
    assert len(air.said()) == 6


def test_a_look_changes_nothing(air: Air, pair: Pair) -> None:
    for name in ("r0", "r1"):
        air.add(name)
    air.start(config("r0 r1"))
    code, links, _ = pair("--check")
    assert (code, links) == (1, {"r0 r1": "not paired at r0, not paired at r1"})
    assert air.said() == []
    assert "bluetooth" not in air.robots.config.read_text()


def test_what_one_side_has_forgotten_is_paired_anew(air: Air, pair: Pair) -> None:
    air.add("r0", paired=["r1"])
    air.add("r1")
    air.start(config("r0 r1", addressed="r0 r1"))
    assert pair("--check")[1] == {"r0 r1": "paired and trusted at r0, not paired at r1"}
    assert pair() == (0, {"r0 r1": "paired"}, {})


def test_no_robot_is_asked_twice_at_once(air: Air, pair: Pair) -> None:
    names = [f"r{n}" for n in range(4)]
    for name in names:
        air.add(name)
    air.start(config(" ".join(names)))
    code, links, _ = pair()
    assert (code, set(links.values()), len(links)) == (0, {"paired"}, 6)
    assert not [line for line in air.said() if "twice" in line]


def test_a_robot_that_is_away_costs_its_own_links_only(air: Air, pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    air.add("r0")
    air.add("r1", away=True)
    air.add("r2")
    air.add("r3", deaf=True)
    air.start(config("r0 r1 r2 r3"))
    monkeypatch.setattr("laptop.fleet.pair.INQUIRY_S", 2.0)
    code, links, robots = pair()
    assert code == 1
    assert links["r0 r2"] == "paired"
    assert links["r0 r1"] == "r0: B8:27:EB:00:00:11 was not found within 2 s: is it in range?"
    assert links["r2 r3"] == "r3 did not take part"
    assert robots == {"r3": "bluetoothd does not run: systemctl status bluetooth"}


def test_a_robot_that_is_another_one(air: Air, pair: Pair) -> None:
    for name in ("r0", "r1", "r2"):
        air.add(name)
    text = config("r0 r1 r2", addressed="r0 r1 r2").replace("00:10", "00:99")
    air.spec["r1"]["address"], air.spec["r2"]["address"] = air.spec["r2"]["address"], air.spec["r1"]["address"]
    air.start(text)
    code, links, robots = pair()
    assert code == 1
    assert robots["r0"] == (
        "its address is B8:27:EB:00:00:10, swarm.toml says B8:27:EB:00:00:99: mend it, or give the robot its name"
    )
    assert robots["r1"] == ("its address B8:27:EB:00:00:12 is that of r2 in swarm.toml: one of them is another robot")
    assert "did not take part" in links["r1 r2"]
    assert air.said() == []


def test_a_stranger_is_refused_while_a_robot_waits_for_its_neighbour(air: Air) -> None:
    for name in ("r0", "r1", "r2"):
        air.add(name)
    air.start(config("r0 r1 r2"))
    ssh = Ssh(air.robots.ssh_config)
    first, second = str(air.spec["r0"]["address"]), str(air.spec["r1"]["address"])

    async def both() -> tuple[str, str]:
        listening, end = asyncio.Event(), asyncio.Event()
        wait = {"do": "listen", "peer": first, "inquiry": 9.0}
        waiting = asyncio.create_task(
            remote.call(ssh, Host("r1", "r1"), "pairing", wait, told=lambda _: listening.set(), until=end)
        )
        await listening.wait()
        assert _programs(air) != []
        call = {"do": "call", "peer": second, "inquiry": 9.0}
        stranger = await remote.call(ssh, Host("r2", "r2"), "pairing", call)
        end.set()  # as a laptop that gives it up, or is closed
        return stranger["problem"], (await waiting)["problem"]

    assert asyncio.run(both()) == ("the other side's agent said no", f"{first} has not paired with it")


def test_nothing_is_left_behind(air: Air, pair: Pair) -> None:
    air.add("r0")
    air.add("r1")
    air.start(config("r0 r1"))
    assert pair()[0] == 0
    assert _programs(air) == []


def _programs(air: Air) -> list[Path]:
    """Our programs that run on these robots; other tests may run some on theirs at the same time."""
    ours, there = remote.BOOT[:60].encode(), os.fsencode(air.folder)
    processes = Path("/proc").glob("[0-9]*")
    return [path for path in processes if ours in _read(path / "cmdline") and there in _read(path / "environ")]


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""
