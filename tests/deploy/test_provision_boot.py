"""`swarm provision` on real Debian systems, booted under systemd in containers and reached by real ssh.

What makes them Raspberry Pis is faked: the board's name, config.txt and cmdline.txt, the body and the UWB module. Real
are apt, dpkg, systemd, sshd, sudo, the reboot, the bundle and the release.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from argparse import ArgumentParser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import debian
import pytest

from bench.rigs.ports import free_port
from laptop.cli.robots import doctor, provision, status
from laptop.fleet.core.wish import PACKAGES, SUITES
from laptop.fleet.provision import Rig
from laptop.fleet.release import bundle
from swarm.config.keyfile import new_key_file

ROOT = Path(__file__).parents[2]
TOOLS = ("systemd-nspawn", "mmdebstrap", "ssh", "ssh-keygen", "apt-get")
PLACES = {"model": "/rig/model", "kernel": "/rig/kernel"}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1500),
    pytest.mark.skipif(
        not os.environ.get("CI") and (os.geteuid() != 0 or any(shutil.which(tool) is None for tool in TOOLS)),
        reason="needs root, and: apt-get install systemd-container mmdebstrap openssh-client",
    ),
]

CONFIG = """network = "rig"
[topology]
edges = []
[[robots]]
name = "r0"
bluetooth = "B8:27:EB:00:00:10"
[dwm]
source = "serial:/dev/serial0"
"""

SSHD = """Port {port}
ListenAddress 127.0.0.1
PasswordAuthentication no
UsePAM no
"""

BODY = """[Service]
ExecStart=
ExecStart=/opt/swarm/current/bin/python -m sim.body
Environment=SWARM_RUNTIME=/run/swarm SWARM_SIM_LYING=front PYTHONPATH=/rig/simulated
"""
"""The simulated body lies on its front: one that stands would fall where a busy machine holds up its loop, which has no
real-time priority in a container, and the doctor would rightly say so."""


def sh(*words: object) -> str:
    return subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True).stdout


@dataclass
class Booted:
    """A container that runs, and how to reach it."""

    folder: Path
    root: Path
    suite: str

    def ssh(self, command: str) -> str:
        return sh("ssh", "-F", self.folder / "ssh_config", "r0", command)

    def provision(self, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, str], str]:
        """Exit code, state by step, and the outcome."""
        parser = ArgumentParser()
        provision.add_arguments(parser)
        common = ["r0", "--json", "--bundle", self.folder / "bundle", "--key", self.folder / "key", *arguments]
        common += ["--config", self.folder / "swarm.toml", "--ssh-config", self.folder / "ssh_config"]
        code = provision.run(parser.parse_args([str(word) for word in common]), Rig(places=PLACES), "amd64")
        outcome = json.loads(capsys.readouterr().out)["robots"]["r0"]
        if code and "install" in outcome["text"]:
            outcome["text"] += self.ssh("sudo journalctl --no-pager --lines=40 --unit='swarm-*'")
        parts = [line.split(": ", 2) for line in outcome["lines"]]
        return code, {part[0]: part[1] for part in parts if len(part) == 3}, str(outcome["text"])


@pytest.fixture(scope="module", params=[*SUITES])
def pi(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Booted]:
    """A fresh Debian that looks like a Pi, booted."""
    suite = str(request.param)
    folder = tmp_path_factory.mktemp(suite)
    root, port = folder / "root", free_port()
    debian.unpack(suite, root)
    sh("chroot", root, "apt-get", "-qq", "purge", "--yes", "--autoremove", "python3-venv")  # what provisioning brings
    sh("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / "id")
    sh("chroot", root, "useradd", "--create-home", "--shell", "/bin/sh", "--password", "*", "pi")
    host_key = (root / "etc/ssh/ssh_host_ed25519_key.pub").read_text()
    files = {
        "rig/model": "Raspberry Pi Zero 2 W Rev 1.0\0", "rig/kernel": "6.12.25+rpt-rpi-v8\n",
        "boot/firmware/config.txt": "dtparam=audio=on\n",
        "boot/firmware/cmdline.txt": "console=serial0,115200 rootwait\n",
        "lib/firmware/synaptics/SYN43430B0.hcd": "", "etc/hostname": "raspberrypi\n",
        "home/pi/.ssh/authorized_keys": (folder / "id.pub").read_text(),
        "etc/sudoers.d/010_pi-nopasswd": "pi ALL=(ALL) NOPASSWD: ALL\n",
        "etc/ssh/sshd_config": SSHD.format(port=port),
        "etc/systemd/system/swarm-balancer.service.d/90-rig.conf": BODY,
    }  # fmt: skip
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    shutil.copytree(ROOT / "sim", root / "rig/simulated/sim", ignore=shutil.ignore_patterns("__pycache__"))
    sh("chroot", root, "chown", "-R", "pi:pi", "/home/pi")
    (folder / "known_hosts").write_text(f"[127.0.0.1]:{port} {host_key}")
    (folder / "ssh_config").write_text(
        f"Host r0\n  HostName 127.0.0.1\n  Port {port}\n  User pi\n  IdentityFile {folder}/id\n  IdentitiesOnly yes\n"
        f"  UserKnownHostsFile {folder}/known_hosts\n  BatchMode yes\n"
    )
    (folder / "swarm.toml").write_text(CONFIG)
    new_key_file(folder / "key", time.time())
    sources = [bundle.Archive(debian.MIRROR, suite, bundle.DEBIAN_KEYS)]
    bundle.download(folder / f"bundle/{suite}-amd64", sources, "amd64", PACKAGES)
    sh(ROOT / "deploy/release", "--machine", "x86_64", "--python", SUITES[suite], folder / "bundle")
    # No network of its own: sshd listens on this machine's loopback. It ends with 133 to be booted again.
    boot = f"systemd-nspawn --directory={root} --register=no --keep-unit -q -b"
    with (folder / "console").open("w") as console:
        container = subprocess.Popen(
            ["sh", "-c", f"while :; do {boot}; [ $? = 133 ] || exit; done"],
            stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True,
        )  # fmt: skip
    booted = Booted(folder, root, suite)
    try:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            with contextlib.suppress(subprocess.CalledProcessError):
                booted.ssh("true")
                break
            time.sleep(0.2)
        yield booted
    finally:
        with contextlib.suppress(subprocess.CalledProcessError):
            booted.ssh("sudo systemctl poweroff --no-block")
        try:
            container.wait(30)
        except subprocess.TimeoutExpired:
            os.killpg(container.pid, signal.SIGTERM)
            container.wait(30)
        shutil.rmtree(root, ignore_errors=True)


def changed_after(root: Path, moment: float) -> list[str]:
    """Files of settings, programs and releases that were written since."""
    found = []
    for top in ("etc", "usr", "opt", "boot", "lib"):
        for path in (root / top).rglob("*"):
            with contextlib.suppress(OSError):
                if path.lstat().st_mtime > moment and not path.is_dir():
                    found.append(str(path.relative_to(root)))
    return found


def test_a_fresh_system_becomes_a_robot_and_again_changes_nothing(
    pi: Booted, capsys: pytest.CaptureFixture[str]
) -> None:
    code, states, text = pi.provision(capsys, "--check")
    assert code == 0, text
    assert states["packages"] == "would change"
    code, states, text = pi.provision(capsys)
    assert code == 0, text
    for step in ("packages", "boot", "cmdline", "i2c", "radio", "realtime", "network", "name", "reboot", "release"):
        assert states[step] == "changed", states
    assert pi.ssh("hostname").strip() == "r0"
    assert pi.ssh("dpkg-query -W -f '${db:Status-Abbrev}' python3-bluez python3-venv").split() == ["ii", "ii"]
    assert pi.ssh("/opt/swarm/current/bin/python -c 'import bluetooth; print(bluetooth.RFCOMM)'").strip() == "3"
    assert pi.ssh("systemctl is-active swarm-bus swarm-mesh swarm-balancer swarm-dwm").split() == ["active"] * 4
    assert pi.ssh("sudo stat -L -c '%a %U' /etc/swarm/key").split() == ["600", "swarm-mesh"]
    assert "isolcpus=3" in pi.ssh("cat /boot/firmware/cmdline.txt")
    # A file's time is the kernel's, which is a tick behind the clock that we read.
    moment = time.time() + 0.02
    code, states, text = pi.provision(capsys)
    assert code == 0, text
    assert set(states.values()) == {"ok"}, states
    assert text == "0 steps changed, all others were ok"
    assert changed_after(pi.root, moment) == []


def test_the_doctor_finds_it_well_but_for_what_a_container_lacks(
    pi: Booted, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = ArgumentParser()
    doctor.add_arguments(parser)
    words = ["r0", "--real", "--json", "--config", pi.folder / "swarm.toml", "--ssh-config", pi.folder / "ssh_config"]
    assert doctor.run(parser.parse_args([str(word) for word in words]), Rig(places=PLACES)) == 1
    found = json.loads(capsys.readouterr().out)["robots"]["r0"]
    # Another processor, no module at its port, no radio.
    wrong = {name: each["text"] for name, each in found.items() if each["state"] == "bad"}
    assert set(wrong) == {"system", "module", "adapter"}, wrong
    assert "bluetoothd" in wrong["adapter"]
    for check in ("packages", "boot", "name", "release", "config", "key", "services", "devices", "body", "battery"):
        assert found[check]["state"] == "ok", found[check]


def test_status_and_z_sub_see_its_services(pi: Booted, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--config", str(pi.folder / "swarm.toml"), "--ssh-config", str(pi.folder / "ssh_config")]
    parser = ArgumentParser()
    status.add_arguments(parser)
    assert status.run(parser.parse_args(["--json", *where])) == 0
    row = json.loads(capsys.readouterr().out)["robots"]["r0"]
    assert row["failed"] == []
    assert row["mode"] == "idle"
    assert row["release"].startswith("0.1.0-")
    assert row["battery_v"] > 5.0
    watch = ["--robots", "r0", "swarm/*/balancer/state", "--count", "3", "--seconds", "60", "--json"]
    lines = [json.loads(line) for line in sh(sys.executable, "-m", "laptop.cli.z_sub", *watch, *where).splitlines()]
    assert [line["key"] for line in lines] == ["swarm/r0/balancer/state"] * 3
    assert lines[0]["value"]["ticks"] < lines[2]["value"]["ticks"]


def test_a_robot_that_was_left_half_done_is_finished(pi: Booted, capsys: pytest.CaptureFixture[str]) -> None:
    """A package half installed, a file half gone: the next run mends that and nothing else."""
    pi.ssh("sudo dpkg --remove --force-depends rfkill && sudo rm /etc/security/limits.d/60-swarm.conf")
    code, states, text = pi.provision(capsys)
    assert code == 0, text
    assert {step for step, state in states.items() if state == "changed"} == {"packages", "realtime"}
    assert text == "2 steps changed, all others were ok"


def test_without_the_bundle_nothing_is_touched(pi: Booted, capsys: pytest.CaptureFixture[str]) -> None:
    pi.ssh("sudo dpkg --remove --force-depends rfkill && sudo rm /etc/security/limits.d/60-swarm.conf")
    (pi.folder / "bundle" / f"{pi.suite}-amd64").rename(pi.folder / "bundle/buster-amd64")
    moment = time.time() + 0.02
    code, _, text = pi.provision(capsys)
    assert code == 1
    assert f"without rfkill, and no bundle for {pi.suite}" in text
    assert changed_after(pi.root, moment) == []
