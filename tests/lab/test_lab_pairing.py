"""Two whole robots with bluetoothd: `swarm pair` by ssh, encrypted links, strangers refused, PyBluez's discovery."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lab.inside import command, furnish
from lab.radio.remote import Radio
from lab.vm.machine import Machine

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(900)]

COMPATIBLE = """mkdir -p /run/systemd/system/bluetooth.service.d
printf '[Service]\\nExecStart=\\nExecStart=/usr/libexec/bluetooth/bluetoothd -C\\n' \
    >/run/systemd/system/bluetooth.service.d/lab.conf
systemctl daemon-reload
systemctl restart bluetooth
"""
"""Service records need bluetoothd's old door."""

POWERED = "for i in $(seq 100); do bluetoothctl show | grep -q 'Powered: yes' && exit 0; sleep 0.5; done; exit 1"


@pytest.fixture
def radio(tmp_path: Path) -> Iterator[Radio]:
    with Radio(tmp_path, 2, machines=True) as made:
        yield made


def pair(tmp_path: Path, robots: list[Machine], *words: str) -> dict[str, object]:
    """`swarm pair` of the host."""
    config, ssh = tmp_path / "swarm.toml", tmp_path / "ssh_config"
    names = [robot.name for robot in robots]
    text = "".join(f'[[robots]]\nname = "{name}"\nhost = "lab-{name}"\n' for name in names)
    config.write_text(f'network = "lab"\n{text}[topology]\nedges = [["r0", "r1"]]\n[mesh]\ninsecure = true\n')
    ssh.write_text(
        "".join(
            f"Host lab-{robot.name}\n HostName 127.0.0.1\n Port {robot.port}\n User root\n"
            f" IdentityFile {robot.ssh_words()[2]}\n StrictHostKeyChecking no\n UserKnownHostsFile /dev/null\n"
            for robot in robots
        )
    )
    asked = ["pair", "--config", str(config), "--ssh-config", str(ssh), "--json", "--timeout", "300", *words]
    done = subprocess.run([sys.executable, "-m", "swarm.cli", *asked], capture_output=True, text=True)
    assert done.stdout, done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_pairing_encryption_and_service_records(machine: Callable[..., Machine], radio: Radio, tmp_path: Path) -> None:
    robots = [machine(f"r{i}", memory_mb=384, radio=tmp_path / f"radio-{i}") for i in (0, 1)]
    for robot in robots:
        robot.start()
        furnish(robot)
        robot.run(COMPATIBLE, 120)
        robot.run(POWERED, 120)
    first, second = robots
    assert pair(tmp_path, robots)["links"] == {"r0 r1": "paired"}
    assert pair(tmp_path, robots, "--check")["links"] == {"r0 r1": "paired"}

    def talk() -> tuple[int, str, str]:
        """Exit code and output of the caller, and what the called one said."""
        a, b = radio.addresses
        number = second.spawn(command(f"tests/lab/inside_peer.py listen {b} {a} >/tmp/listen 2>&1"), 300)
        second.run("until grep -q listening /tmp/listen; do sleep 0.2; done", 120)
        code, said = _result(first, command(f"tests/lab/inside_peer.py dial {a} {b}"))
        if code == 0:
            second.wait(number, 120)
        else:
            second.run("pkill -f inside_peer", code=None)
        return code, said, second.run("cat /tmp/listen")

    code, said, heard = talk()
    assert code == 0, said + heard
    assert "b'and back' level 2" in said
    assert "b'encrypted' level 2" in heard
    assert "robot r0" in heard
    # A device whose key the other side has not (any more) is refused.
    second.run(f"bluetoothctl remove {radio.addresses[0]}; bluetoothctl pairable off; sleep 1", code=None)
    radio.order("drop", one=radio.addresses[0], other=radio.addresses[1])
    time.sleep(1.0)
    code, said, _ = talk()
    assert code != 0
    assert "Error" in said
    # Paired anew, it is taken again.
    assert pair(tmp_path, robots, "--again")["links"] == {"r0 r1": "paired"}
    number = second.spawn(command(f"tests/lab/inside_peer.py listen {radio.addresses[1]} {radio.addresses[0]}"), 300)
    second.run("bluetoothctl discoverable on", 60)
    lines = first.run(command("-m services.mesh.discover --seconds 2.56 --services --json"), 180).splitlines()
    found = {row["address"]: row for row in map(json.loads, lines)}
    assert found[radio.addresses[1]]["channel"] == 4
    code, said = _result(first, command(f"tests/lab/inside_peer.py dial {radio.addresses[0]} {radio.addresses[1]}"))
    assert code == 0, said
    assert second.wait(number, 120).code == 0


def _result(machine: Machine, words: str) -> tuple[int, str]:
    result = machine.wait(machine.spawn(words, 150), 180)
    return result.code, result.output
