"""A robot's services under a real systemd, in a container that boots twice: tests/deploy/inside.py has the checks.

Needs root, systemd-nspawn and mmdebstrap (packages systemd-container, mmdebstrap) and the network.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from swarm.keyfile import new_key_file

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TOOLS = ("systemd-nspawn", "mmdebstrap")
SUITE, PYTHON = "bookworm", "3.11"
PACKAGES = "systemd,systemd-sysv,dbus,udev,python3,python3-venv"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(
        not os.environ.get("CI") and (os.geteuid() != 0 or any(shutil.which(tool) is None for tool in TOOLS)),
        reason="needs root, and: apt-get install systemd-container mmdebstrap",
    ),
]

SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm", "swarm-app@consensus")
CHECKS = (
    "refuses a wrong config",
    "installs",
    "runs an app",
    "everything talks",
    "again changes nothing",
    "holds its privileges",
    *(f"{service} killed and hung" for service in SERVICES),
    "stands without a bus",
    "a full disk",
    "the fleet can ask it",
    "memory",
    "a release that does not run",
    "stops and is armed",
    "is up after a reboot",
    "everything talks after it",
    "the fleet can ask it after that",
    "uninstalls",
)
LIMITS = {"pss_mib": 140.0}
"""What a check measures must be below; times depend on the machine and are only printed."""

Report = dict[str, dict[str, object]]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Report]:
    """Build the root, install our release in it, boot it twice, and read what the checks inside have found."""
    work = tmp_path_factory.mktemp("boot")
    root = work / "root"
    mirror = "http://deb.debian.org/debian"
    mmdebstrap = ["mmdebstrap", "--quiet", "--variant=minbase", f"--include={PACKAGES}", SUITE, str(root), mirror]
    subprocess.run(mmdebstrap, check=True)
    made = subprocess.run(
        [str(ROOT / "deploy/release"), "--python", PYTHON, str(work)], check=True, capture_output=True, text=True
    )
    rig = root / "rig"
    rig.mkdir()
    shutil.unpack_archive(made.stdout.split()[-1], rig, filter="tar")
    shutil.copy(HERE / "inside.py", rig)
    new_key_file(rig / "swarm.key", int(time.time()))
    for phase in ("install", "reboot"):
        unit = root / "etc/systemd/system/rig.service"
        unit.write_text(
            "[Unit]\nAfter=multi-user.target\n[Service]\nType=exec\nStandardOutput=journal+console\n"
            f"ExecStart=/usr/bin/python3 /rig/inside.py {phase}\n"
        )
        wants = root / "etc/systemd/system/default.target.wants"
        wants.mkdir(exist_ok=True)
        (wants / "rig.service").unlink(missing_ok=True)
        (wants / "rig.service").symlink_to("/etc/systemd/system/rig.service")
        boot = [
            "systemd-nspawn",
            f"--directory={root}",
            "--register=no",
            "--keep-unit",
            "--private-network",
            "-q",
            "-b",
        ]
        subprocess.run(boot, stdin=subprocess.DEVNULL, capture_output=True, timeout=400)
    lines = [json.loads(line) for line in (rig / "report").read_text().splitlines()]
    yield {line["check"]: line for line in lines}
    shutil.rmtree(root)


@pytest.mark.parametrize("check", CHECKS)
def test_on_a_booted_robot(report: Report, check: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = report[check]
    measured = {name: value for name, value in found.items() if name not in ("check", "problem")}
    with capsys.disabled():
        if measured:
            sys.stdout.write(f"\n{check}: {', '.join(f'{name} {value:.3g}' for name, value in measured.items())}")
    assert found["problem"] == ""
    for name, limit in LIMITS.items():
        assert name not in measured or float(str(measured[name])) <= limit


def test_the_report_has_no_other_checks(report: Report) -> None:
    assert set(report) == set(CHECKS)
