"""Two whole machines with bluetoothd: `swarm pair` by ssh, encrypted links, strangers refused, PyBluez, the mesh's own
units over it, and a bluetoothd that is restarted in mid-run.

One after the other, each from where the one before has left the two.
"""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from lab import waiting
from lab.inside import command, furnish
from lab.radio.remote import Radio
from lab.vm.build import Image
from lab.vm.machine import PLAIN, Machine, Result
from lab.waiting import PATIENCE_S, until
from laptop.fleet.core import settings, texts
from swarm.config.keyfile import new_key_file
from swarm.recording.run import Run

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(1200)]

COMPATIBLE = """mkdir -p /run/systemd/system/bluetooth.service.d
printf '[Service]\\nExecStart=\\nExecStart=/usr/libexec/bluetooth/bluetoothd -C\\n' \
    >/run/systemd/system/bluetooth.service.d/lab.conf
systemctl daemon-reload
systemctl restart bluetooth
for i in $(seq 200); do timeout 10 bluetoothctl show | grep -q 'Powered: yes' && exit 0; sleep 0.3; done; exit 1
"""
"""Service records need bluetoothd's old door."""

PEER = "tests/lab/inside/inside_peer.py"
ITERATIONS = 400

CONFIG = """network = "lab"
[[robots]]
name = "r0"
host = "lab-r0"
bluetooth = "{}"
[[robots]]
name = "r1"
host = "lab-r1"
bluetooth = "{}"
[topology]
edges = [["r0", "r1"]]
[mesh]
{}
[apps.consensus.robots.r0]
value = 0.3
[apps.consensus.robots.r1]
value = 1.7
"""
MESH = 'key = "/etc/swarm/key"\nrfcomm_encrypt = true\nheartbeat = 1.0\nsuspect = 10.0\ndead = 30.0'


class Robots:
    """Both machines, their radio, and the host's view of them."""

    def __init__(self, folder: Path, radio: Radio, machines: list[Machine]) -> None:
        self.folder = folder
        self.radio = radio
        self.machines = machines
        self.first, self.second = machines
        self.config = folder / "swarm.toml"
        self.addresses = radio.addresses[: len(machines)]
        self.config.write_text(CONFIG.format(*self.addresses, MESH))
        self.boot()

    def boot(self) -> None:
        """Switch both on, and wait until they can be reached: by other addresses after each start."""
        for machine in self.machines:
            machine.switch_on()
        with ThreadPoolExecutor() as pool:
            list(pool.map(prepare, self.machines))
        (self.folder / "ssh_config").write_text(
            "".join(
                f"Host lab-{robot.name}\n HostName {robot.address}\n User root\n"
                f" IdentityFile {robot.ssh_words()[2]}\n StrictHostKeyChecking no\n UserKnownHostsFile /dev/null\n"
                for robot in self.machines
            )
        )

    def pair(self, *words: str) -> str:
        """`swarm pair` of the host: what it says of the link."""
        asked = ["--config", str(self.config), "--ssh-config", str(self.folder / "ssh_config"), "--json"]
        command = [sys.executable, "-m", "laptop.cli", "pair", *asked, "--timeout", "200", *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        output, errors = waiting.finished(f"swarm pair {' '.join(words)}", process)
        assert output, errors
        answer = json.loads(output.splitlines()[-1])
        assert all(each["ok"] for each in answer["robots"].values()), answer
        return str(answer["links"]["r0 r1"])

    def state(self) -> str:
        """The air's links, and each robot's adapter and devices as bluetoothd has them."""
        said = [
            robot.run(
                "hciconfig hci0 | sed -n 3p; bluetoothctl devices Paired; systemctl is-active bluetooth", code=None
            )
            for robot in self.machines
        ]
        return f"air {self.radio.order('look')}, {said}"

    def scans(self) -> list[bool]:
        """Whether each listens to calls."""
        return ["PSCAN" in robot.run("hciconfig hci0") for robot in self.machines]

    @contextmanager
    def second_listens(self, how: str = "listen") -> Iterator[None]:
        """The second robot answers calls meanwhile; /tmp/said there has what it says of them."""
        a, b = self.addresses
        self.second.run("rm -f /tmp/said")
        number = self.second.spawn(command(f"{PEER} {how} {b} {a} >/tmp/said 2>&1"), 600)
        self.second.run("until grep -q listening /tmp/said; do sleep 0.2; done", 120)
        try:
            yield
        finally:
            self.second.run("kill $(cat /tmp/peer)", code=None)
            self.second.wait(number, 60, "the listening program ends")

    def call(self, caller: Machine, own: str, how: str = "encrypted", pages: int = 5) -> Result:
        """A machine calls the second robot. A page ends after 5 s, which a busy host may take to let the robot's
        controller answer it: then it calls again, so many times in all."""
        words = command(f"{PEER} dial-{how} {own} {self.addresses[1]}")
        while True:
            result = caller.wait(caller.spawn(words, 150), 180, f"the call ({how}) comes to an end", self.state)
            pages -= 1
            if pages <= 0 or "host is down" not in result.output:
                return result

    def talk(self, pages: int = 5) -> tuple[int, str, str]:
        """The first calls the second over an encrypted link: its exit code, what it said, what the second said."""
        with self.second_listens():
            result = self.call(self.first, self.addresses[0], pages=pages)
        return result.code, result.output, self.second.run("cat /tmp/said")


def prepare(machine: Machine) -> None:
    """What is booted is ready for the tests."""
    machine.wait_booted()
    furnish(machine)
    machine.run(COMPATIBLE, 180)


@pytest.fixture(scope="module")
def robots(lab_image: Image, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robots]:
    """Booted both, powered, paired with nobody."""
    folder = tmp_path_factory.mktemp("pair")
    with Radio(folder, 3, machines=True) as radio:
        machines = [
            Machine(lab_image, folder / name, name, memory_mb=384, radio=folder / f"radio-{number}")
            for number, name in enumerate(("r0", "r1"))
        ]
        try:
            yield Robots(folder, radio, machines)
        finally:
            for machine in machines:
                machine.kill()
            counts = radio.order("look")["counts"]
    assert not [name for name in counts if name.startswith("unknown")], counts


@pytest.fixture(scope="module")
def stranger(lab_image: Image, robots: Robots) -> Iterator[Machine]:
    """A third device in their reach, of another owner; inquiries do not find it."""
    with Machine(
        lab_image, robots.folder / "r2", "stranger", init=PLAIN, memory_mb=256, radio=robots.folder / "radio-2"
    ) as made:
        furnish(made)
        made.run("until hciconfig hci0 up; do sleep 0.2; done; hciconfig hci0 sspmode 1; hciconfig hci0 pscan", 60)
        yield made


def test_an_adapter_that_is_paired_with_nobody_is_deaf(robots: Robots) -> None:
    assert robots.scans() == [False, False]
    code, said, _ = robots.talk(pages=1)
    assert code == 1
    assert "deaf to robots it is not paired with (swarm pair)" in said


def test_swarm_pair_pairs_them(robots: Robots) -> None:
    assert robots.pair("--check") == "not paired at r0, not paired at r1"
    assert robots.pair() == "paired"
    assert robots.pair("--check") == "paired"
    until("the paired robots listen", lambda: robots.scans() == [True, True], state=robots.scans)


def test_a_power_cut_right_after_swarm_pair_takes_no_key(robots: Robots) -> None:
    assert robots.pair("--again") == "paired"
    for robot in robots.machines:
        robot.kill()
    robots.boot()
    assert robots.pair("--check") == "paired"
    until("the paired robots listen", lambda: robots.scans() == [True, True], state=robots.scans)


def test_links_are_encrypted_when_asked_for(robots: Robots) -> None:
    robots.radio.order("drop", one=robots.addresses[0], other=robots.addresses[1])
    before = robots.radio.order("look")["counts"]["encrypted"]
    code, said, heard = robots.talk()
    assert code == 0, said + heard
    assert said.startswith("b'and back' level 2")
    assert "b'encrypted' level 2 robot r0" in heard
    # Not only the socket says so: the controllers were told to.
    assert robots.radio.order("look")["counts"]["encrypted"] == before + 1


@pytest.mark.parametrize("encrypt", ["encrypted", "plain"])
def test_a_device_that_nobody_knows_is_refused(robots: Robots, stranger: Machine, encrypt: str) -> None:
    """Whether it wants an encrypted link or not; and the robot still hears its own."""
    own = robots.radio.addresses[2]
    with robots.second_listens():
        refused = robots.call(stranger, own, encrypt)
        assert refused.code == 1, refused.output
        assert "refused: [Errno 111]" in refused.output
        assert not [pair for pair in robots.radio.order("look")["encrypted"] if own in pair]
        called = robots.call(robots.first, robots.addresses[0])
        assert called.code == 0, called.output


def test_pybluez_finds_the_robot_and_its_mesh(robots: Robots) -> None:
    b = robots.addresses[1]
    # PyBluez makes a record only while the adapter can be found.
    robots.second.run("bluetoothctl discoverable on; until hciconfig hci0 | grep -q ISCAN; do sleep 0.2; done", 60)
    rows: list[dict[str, Any]] = []

    def found() -> bool:
        said = robots.first.run(command("-m swarm.onboard discover --seconds 2.56 --services --json"), 180)
        rows[:] = map(json.loads, said.splitlines())
        return {row["address"]: row["channel"] for row in rows} == {b: 4}

    with robots.second_listens("advertise"):
        until("PyBluez finds the robot and its mesh", found, state=lambda: f"{rows}, {robots.state()}")
        called = robots.call(robots.first, robots.addresses[0])
        assert called.code == 0, called.output


def test_who_was_forgotten_is_refused_and_may_be_paired_again(robots: Robots) -> None:
    a = robots.addresses[0]
    robots.second.run(f"bluetoothctl remove {a}; bluetoothctl pairable off")
    until("the link has ended", lambda: not robots.radio.order("look")["links"], state=robots.state)
    robots.second.run("hciconfig hci0 pscan")  # deaf otherwise; a paired third robot makes it hear
    code, said, heard = robots.talk()
    assert code == 1, said + heard
    assert "it has lost the key of the pairing" in said
    assert not robots.radio.order("look")["encrypted"]
    assert "not paired at r1" in robots.pair("--check")
    assert robots.pair() == "paired"
    code, said, heard = robots.talk()
    assert code == 0, said + heard


def test_page_scans_as_provisioned_reach_the_controller(robots: Robots) -> None:
    """bluetoothd tells the kernel, and the kernel its controller: robots hear calls four times as often. But it tells
    only after it has switched the adapter on, so they hold from the next time that the adapter is switched on."""
    own = robots.addresses[0]

    def powered() -> bool:
        return "Powered: yes" in robots.first.run("timeout 10 bluetoothctl show", code=None)

    text = robots.first.run(f"cat {settings.BLUETOOTH_CONF}")
    for key, value in settings.PAGE_SCAN.items():
        text = texts.with_setting(text, "BR", key, value)
    (robots.first.share / "main.conf").write_text(text)
    robots.first.run(f"cp /share/main.conf {settings.BLUETOOTH_CONF}; systemctl restart bluetooth", 90)
    until("bluetoothd has switched the adapter on", powered, state=robots.state)
    assert robots.radio.order("look")["scans"][own] == pytest.approx(1.28), "a switch off and on is needless by now"
    robots.first.run("bluetoothctl power off; bluetoothctl power on", 90)
    until(
        "scans each 0.32 s",
        lambda: robots.radio.order("look")["scans"][own] == pytest.approx(0.32),
        state=robots.state,
    )


def test_a_run_outlives_restarts_of_bluetoothd(robots: Robots) -> None:
    """The mesh's units over encrypted links with a key; bluetoothd switches the adapter off and on under them."""
    key = robots.folder / "swarm.key"
    new_key_file(key, int(time.time()))
    own = robots.folder / "own.toml"
    own.write_text(CONFIG.format(*robots.addresses, "insecure = true"))
    words = ["consensus", "--config", str(own), "--virtual", "--iterations", str(ITERATIONS), "--json"]
    record = ["--record", str(robots.folder / "simulated")]
    waiting.run("the simulation", [sys.executable, "-m", "laptop.cli.runs.sim", *words, *record])
    for robot in robots.machines:
        (robot.share / "swarm.toml").write_text(robots.config.read_text())
        (robot.share / "swarm.key").write_bytes(key.read_bytes())
        robot.run(
            "install -m 644 /share/swarm.toml /etc/swarm/swarm.toml;"
            "install -m 600 -o swarm-mesh /share/swarm.key /etc/swarm/key; mkdir -p /etc/swarm/apps;"
            f"printf 'ARGUMENTS=--iterations {ITERATIONS} --run 1ab --record\\n'"
            " >/etc/swarm/apps/consensus.env; systemctl start swarm-bus"
        )
        robot.spawn(
            f"/opt/swarm/current/bin/z_sub --json 'swarm/{robot.name}/app/consensus/state' >/tmp/states", 4 * PATIENCE_S
        )
        robot.run("systemctl start --no-block swarm-mesh swarm-app@consensus")

    def reached() -> list[int]:
        """The latest iteration of each."""
        said = [robot.run("tail -n 1 /tmp/states", 60) for robot in robots.machines]
        return [json.loads(each)["value"]["k"] if each else -1 for each in said]

    def wait_reached(iteration: int) -> None:
        until(
            f"both at iteration {iteration}",
            lambda: min(reached()) >= iteration,
            state=lambda: f"{journals(robots)}\niterations {reached()}, {robots.state()}",
            every=0.3,
        )

    wait_reached(5)
    for robot in robots.machines:
        before = max(reached())
        robot.run("systemctl restart bluetooth", 90)
        assert before < ITERATIONS - 20
        wait_reached(before + 5)
    until(
        "the link is encrypted",
        lambda: robots.radio.order("look")["encrypted"] == [robots.addresses],
        state=robots.state,
    )
    wait_reached(ITERATIONS)
    simulated = Run(robots.folder / "simulated").trajectories("consensus")
    for robot in robots.machines:
        robot.run("systemctl stop swarm-app@consensus swarm-mesh swarm-bus; cp -r /var/lib/swarm/runs /share/runs")
        (folder,) = (robot.share / "runs").iterdir()
        rows = Run(folder).trajectories("consensus")[robot.name].rows
        for k in range(ITERATIONS + 1):
            assert rows[k] == simulated[robot.name].rows[k], f"{robot.name}, iteration {k}"


def journals(robots: Robots) -> str:
    return "\n".join(
        robot.run("journalctl -b -u swarm-mesh -u swarm-app@consensus -u bluetooth --no-pager -n 30", code=None)
        for robot in robots.machines
    )
