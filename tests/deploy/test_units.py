"""The units as systemd itself reads them: nothing it warns of, and little that an intruder could use."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.balancer.bridge.child import OOM_SCORE_ADJUST

SYSTEMD = Path(__file__).parents[2] / "deploy" / "systemd"
SERVICES = ("swarm-bus", "swarm-mesh", "swarm-balancer", "swarm-dwm", "swarm-app@consensus")
EXPOSURE = {"swarm-balancer": 40}
"""Ten times systemd's measure of exposure that is allowed at most; 25 for all others."""

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None and not os.environ.get("CI"),
    reason="needs systemd-analyze: sudo apt-get install systemd",
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A root directory with our units, the system's own, and something to start."""
    root = tmp_path_factory.mktemp("root")
    units = root / "etc/systemd/system"
    units.parent.mkdir(parents=True)
    shutil.copytree(SYSTEMD, units)
    system = next(path for path in (Path("/usr/lib/systemd/system"), Path("/lib/systemd/system")) if path.is_dir())
    shutil.copytree(system, root / "usr/lib/systemd/system", symlinks=True)
    python = root / "opt/swarm/current/bin/python"
    python.parent.mkdir(parents=True)
    shutil.copy("/bin/true", python)
    yield root
    shutil.rmtree(root)


@needs_systemd
@pytest.mark.parametrize("unit", [*(f"{service}.service" for service in SERVICES), "swarm.target", "swarm.slice"])
def test_systemd_finds_nothing_wrong(root: Path, unit: str) -> None:
    done = subprocess.run(["systemd-analyze", "verify", f"--root={root}", unit], capture_output=True, text=True)
    ours = [line for line in (done.stdout + done.stderr).splitlines() if "swarm" in line]
    assert (done.returncode, ours) == (0, [])


@needs_systemd
@pytest.mark.parametrize("service", SERVICES)
def test_a_service_is_exposed_to_little_by_its_unit(root: Path, service: str) -> None:
    command = ["systemd-analyze", "security", "--offline=true", f"--root={root}"]
    command += [f"--threshold={EXPOSURE.get(service, 25)}", f"{service}.service"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-400:] + done.stderr


@needs_systemd
def test_the_check_can_fail(root: Path) -> None:
    bare = root / "etc/systemd/system/bare.service"
    bare.write_text("[Service]\nExecStart=/opt/swarm/current/bin/python\nNoSuchSetting=1\n")
    verify = subprocess.run(["systemd-analyze", "verify", f"--root={root}", "bare.service"], capture_output=True)
    assert b"NoSuchSetting" in verify.stderr
    command = ["systemd-analyze", "security", "--offline=true", f"--root={root}", "--threshold=40", "bare.service"]
    assert subprocess.run(command, capture_output=True).returncode != 0


def test_every_service_and_device_is_where_the_scripts_look() -> None:
    """install, uninstall, sysusers and udev name the same services and users as the units."""
    names = {path.name for path in SYSTEMD.glob("swarm*.service")}
    for script in ("install", "uninstall"):
        text = (SYSTEMD.parent / script).read_text()
        assert [name for name in names if name not in text] == []
    users = {
        line.removeprefix("User=")
        for path in SYSTEMD.glob("swarm*.service")
        for line in path.read_text().splitlines()
        if line.startswith("User=")
    }
    made = {line.split()[1] for line in (SYSTEMD / "swarm.sysusers").read_text().splitlines() if line.startswith("u ")}
    assert made == users
    rules = (SYSTEMD / "60-swarm.rules").read_text()
    assert {word.split('"')[1] for word in rules.split() if word.startswith("OWNER=")} <= users


PI_MB, GPU_MB, SYSTEM_MB = 512, 64, 90
"""A Pi Zero 2 W; what its GPU has; what kernel and system need."""


def setting(unit: str, name: str) -> str:
    """The last value of a setting in a unit's file or in what all services share; empty where there is none."""
    files = [SYSTEMD / unit]
    if unit.endswith(".service"):
        files.append(SYSTEMD / "swarm-.service.d/10-common.conf")
    lines = [line for file in files for line in file.read_text().splitlines() if line.startswith(f"{name}=")]
    return lines[-1].partition("=")[2] if lines else ""


def limit_mb(unit: str) -> int:
    """Its MemoryMax=."""
    text = setting(unit, "MemoryMax")
    assert text.endswith("M"), f"{unit} has no limit of memory"
    return int(text[:-1])


def test_all_limits_of_memory_fit_a_pi_however_many_apps_there_are() -> None:
    services = [path.name for path in SYSTEMD.glob("swarm-*.service")]
    limited = [name for name in services if setting(name, "Slice") == "swarm.slice"]
    assert set(services) - set(limited) == {"swarm-balancer.service"}
    assert sum(map(limit_mb, limited)) <= limit_mb("swarm.slice")
    assert limit_mb("swarm.slice") + limit_mb("swarm-balancer.service") <= PI_MB - GPU_MB - SYSTEM_MB


def test_the_balancer_is_the_last_that_is_ended_where_memory_runs_out() -> None:
    scores = {path.name: int(setting(path.name, "OOMScoreAdjust")) for path in SYSTEMD.glob("swarm-*.service")}
    in_order = sorted(scores, key=lambda name: scores[name])
    assert in_order[0] == "swarm-balancer.service"
    assert in_order[-1] == "swarm-app@.service"
    assert scores["swarm-balancer.service"] < -500
    # Its bridge goes before its loop, and takes nothing else with it.
    assert int(OOM_SCORE_ADJUST) >= scores["swarm-app@.service"]
    assert setting("swarm-balancer.service", "OOMPolicy") == "continue"


def test_a_service_at_its_limit_of_memory_is_not_swapped_out() -> None:
    for path in SYSTEMD.glob("swarm-*.service"):
        assert setting(path.name, "MemorySwapMax") == "0"
        assert setting(path.name, "MemoryHigh") == ""
