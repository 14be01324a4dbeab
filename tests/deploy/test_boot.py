"""A robot's services under a real systemd, in a container that boots twice: tests/deploy/inside.py has the checks.

Its neighbour r1 runs beside the container, linked by TCP, and waits while r0 reboots. The app's values never settle:
from the recordings of both every value is worked out again, and must be equal to the bit.

Needs root, systemd-nspawn and mmdebstrap (packages systemd-container, mmdebstrap) and the network.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import debian
import pytest
from neighbour import Neighbour
from room import ANCHORS

from bench.faults import restless_rule
from bench.rigs.ports import free_port
from swarm.config.keyfile import new_key_file
from swarm.core.graph import Graph

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TOOLS = ("systemd-nspawn", "mmdebstrap")
SUITE, PYTHON = "bookworm", "3.11"
APP = ROOT / "bench/faults/restless.py"
ARGUMENTS = ["--run", "1", "--absent", "drop", "--drop-after", "600"]
STARTS = {"r0": 0.0, "r1": 0.5}

CONFIG = """network = "rig"
[topology]
edges = [["r0", "r1"]]
[[robots]]
name = "r0"
link = "tcp:127.0.0.1:{r0}"
[[robots]]
name = "r1"
link = "tcp:127.0.0.1:{r1}"
[mesh]
listen = "127.0.0.1:{own}"
key = "{key}"
[dwm]
source = "serial:/run/rig/r0/dwm.tty"
{anchors}[apps.restless.robots.r1]
value = 0.5
phase = 1.0
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1500),
    pytest.mark.skipif(
        not os.environ.get("CI") and (os.geteuid() != 0 or any(shutil.which(tool) is None for tool in TOOLS)),
        reason="needs root, and: apt-get install systemd-container mmdebstrap",
    ),
]

SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm", "swarm-app@restless")
CHECKS = (
    "refuses a wrong config",
    "installs",
    "runs an app",
    "everything talks",
    "again changes nothing",
    "holds its privileges",
    "a quiet stretch",
    *(f"{service} killed and stopped" for service in SERVICES),
    "the bus hung",
    "all others hung",
    "the balancer is as punctual",
    "stands without a bus",
    "a full disk",
    "the fleet can ask it",
    "memory",
    "a release that does not run",
    "stops and is armed",
    "saves recordings",
    "is up after a reboot",
    "everything talks after it",
    "goes on with the run",
    "the fleet can ask it after that",
    "saves recordings of the second boot",
    "uninstalls",
)
LIMITS = {"pss_mib": 140.0, "boot_s": 15.0}
"""What a check measures must be below; other times depend on the machine, and are only printed."""

BOOT_S = 600.0
"""For one boot with all of its checks, on a machine that others use as well."""


@dataclass
class Rig:
    """What came of both boots."""

    report: dict[str, dict[str, object]]
    recordings: dict[str, list[Path]]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Install our release in a fresh system, boot it twice, and read what the checks inside have found."""
    work = tmp_path_factory.mktemp("boot")
    root = work / "root"
    debian.unpack(SUITE, root)
    made = subprocess.run(
        [str(ROOT / "deploy/release"), "--python", PYTHON, str(work)], check=True, capture_output=True, text=True
    )
    inside = root / "rig"
    inside.mkdir()
    subprocess.run(["tar", "-xf", made.stdout.split()[-1], "-C", str(inside)], check=True)
    for file in (HERE / "inside.py", HERE / "inside_robot.py", APP):
        shutil.copy(file, inside)
    for name in ("sim", "laptop"):
        shutil.copytree(ROOT / name, inside / "simulated" / name, ignore=shutil.ignore_patterns("__pycache__"))
    (inside / "arguments").write_text(" ".join(ARGUMENTS))
    new_key_file(inside / "swarm.key", int(time.time()))
    shutil.copy(inside / "swarm.key", work / "swarm.key")
    ports = {"r0": free_port(), "r1": free_port()}
    (inside / "r0.toml").write_text(CONFIG.format(**ports, own=ports["r0"], key="/etc/swarm/key", anchors=ANCHORS))
    (work / "r1.toml").write_text(CONFIG.format(**ports, own=ports["r1"], key=work / "swarm.key", anchors=ANCHORS))
    units = root / "etc/systemd/system"
    (units / "ssh.service").symlink_to("/dev/null")  # the container shares this machine's network
    (units / "multi-user.target.wants/rig.service").symlink_to("/etc/systemd/system/rig.service")
    with Neighbour(work / "r1.toml", work / "r1", APP, ARGUMENTS):
        for phase in ("install", "reboot"):
            (units / "rig.service").write_text(
                "[Service]\nType=exec\nStandardOutput=journal+console\n"
                f"ExecStart=/usr/bin/python3 /rig/inside.py {phase}\n"
            )
            boot = ["systemd-nspawn", f"--directory={root}", "--register=no", "--keep-unit", "-q", "-b"]
            subprocess.run(boot, stdin=subprocess.DEVNULL, capture_output=True, timeout=BOOT_S)
    lines = [json.loads(line) for line in (inside / "report").read_text().splitlines()]
    recordings = {
        "r0": [path for path in (inside / "install.mcap", inside / "reboot.mcap") if path.exists()],
        "r1": [work / "r1/r1.restless.mcap"],
    }
    yield Rig({line["check"]: line for line in lines}, recordings)
    shutil.rmtree(root)


@pytest.mark.parametrize("check", CHECKS)
def test_on_a_booted_robot(rig: Rig, check: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = rig.report[check]
    measured = {name: value for name, value in found.items() if name not in ("check", "problem")}
    with capsys.disabled():
        if measured:
            sys.stdout.write(f"\n{check}: {', '.join(f'{name} {value:.3g}' for name, value in measured.items())}")
    assert found["problem"] == ""
    for name, limit in LIMITS.items():
        assert name not in measured or float(str(measured[name])) <= limit


def test_the_report_has_no_other_checks(rig: Rig) -> None:
    assert set(rig.report) == set(CHECKS)


def test_all_values_are_those_of_an_undisturbed_run(rig: Rig) -> None:
    """Through everything that was killed, hung and stopped: one epoch up to the reboot, and one behind it."""
    epochs = restless_rule.read(rig.recordings, Graph(("r0", "r1"), [("r0", "r1")]))
    found = restless_rule.compare(epochs, STARTS)
    assert found.wrong == []
    assert [epoch.counter for epoch in epochs.values()] == [0, 1]
    for epoch in epochs.values():
        # The disk that was full has cost some of r0's; r1's are all there, and each of them needs r0's before it.
        assert sorted(epoch.states["r1"]) == list(range(epoch.first, max(epoch.states["r1"]) + 1))
        assert len(epoch.states["r0"]) > 20
    assert found.unknown == 0
    assert found.anew == Counter(r0=1)
