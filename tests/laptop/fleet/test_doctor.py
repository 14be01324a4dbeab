"""`swarm doctor` on a simulated swarm of real services, with faults put in one after the other, each to be named."""

import fcntl
import json
import os
import pty
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import wait_until
from fake_pis import PLACES, add_pi
from fake_robots import FakeRobots
from needs import needs_ssh

from bench.rigs.simulation import Simulation
from laptop.cli import main
from laptop.cli.robots import doctor
from laptop.fleet.core import doctor as core
from laptop.fleet.provision import Rig
from swarm.config.keyfile import new_key_file
from swarm.onboard.bootstrap import examine
from swarm.process.simulations import claim

Report = dict[str, dict[str, dict[str, str]]]


def parsed(words: list[str]) -> doctor.argparse.Namespace:
    parser = doctor.argparse.ArgumentParser()
    doctor.add_arguments(parser)
    return parser.parse_args(words)


def swarm(*words: str) -> None:
    with pytest.raises(SystemExit) as end:
        main(list(words))
    assert end.value.code == 0


@pytest.fixture(scope="module")
def simulation() -> Iterator[Simulation]:
    """Three robots that localize a target for as long as the tests take."""
    with Simulation("localization", "--robots", "3", "--seconds", "3600") as simulation:
        simulation.wait_for("r0", 0, app="localization")
        yield simulation


Ask = Callable[..., tuple[int, Report]]


@pytest.fixture
def ask(simulation: Simulation, capsys: pytest.CaptureFixture[str]) -> Ask:
    def asked(*words: str) -> tuple[int, Report]:
        code = doctor.run(parsed([*words, "--run-dir", str(simulation.run_dir), "--json"]))
        return code, json.loads(capsys.readouterr().out.splitlines()[-1])["robots"]

    return asked


def wrong(report: Report, robot: str) -> dict[str, str]:
    return {check: each["text"] for check, each in report[robot].items() if each["state"] == "bad"}


@pytest.mark.slow
def test_a_swarm_that_is_well_then_one_with_faults(ask: Ask, simulation: Simulation) -> None:
    last: dict[str, Report] = {}

    def well() -> bool:
        code, last["report"] = ask()
        return code == 0

    wait_until(well, what="all robots are well", timeout=60)
    report = last["report"]
    assert set(report) == {"r0", "r1", "r2"}
    assert list(report["r0"]) == [check.name for check in core.CHECKS]
    assert {name for name, each in report["r0"].items() if each["state"] == "ok"} >= {
        "disk", "services", "devices", "firmware", "body", "battery", "module", "ranges", "links", "time"
    }  # fmt: skip

    # An IMU that does not acknowledge.
    swarm("hand", "unplug", "r1", "imu", "--run-dir", str(simulation.run_dir))
    wait_until(lambda: "devices" in wrong(ask("r1")[1], "r1"), what="the IMU's fault is seen")
    code, report = ask("r1", "r0")
    assert code == 1
    assert wrong(report, "r1")["devices"] == "I2C, IMU: Remote I/O error (error 121)"
    assert "Balboa" in report["r1"]["devices"]["remedy"]
    assert wrong(report, "r0") == {}

    # A module that is dead: its line is there, and nobody at its end.
    master, slave = pty.openpty()
    place = simulation.run_dir / "r2/dwm.tty"
    place.unlink()
    place.symlink_to(os.ttyname(slave))
    simulation.kill("r2", "dwm")
    wait_until(lambda: "module" in wrong(ask("r2")[1], "r2"), what="the module's fault is seen", timeout=60)
    _, report = ask("r2")
    assert "it does not answer: is it wired, powered" in wrong(report, "r2")["module"]
    assert "swarm dwm check" in report["r2"]["module"]["remedy"]
    os.close(master)
    os.close(slave)

    # A mesh that hangs: its links go at the neighbours, too.
    simulation.kill("r0", "mesh", "STOP")
    wait_until(lambda: "links" in wrong(ask("r1")[1], "r1"), what="the link's fault is seen", timeout=60)
    code, report = ask("r0", "r1")
    assert wrong(report, "r0")["services"] == "no word from mesh"
    assert wrong(report, "r1")["links"].startswith("no link to r0")
    simulation.kill("r0", "mesh", "CONT")


def test_what_is_asked_wrongly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_dir = tmp_path / "run"
    with claim(run_dir):
        (run_dir / "swarm.toml").write_text('network = "test"\n[[robots]]\nname = "r0"\n')
        (run_dir / "r0").mkdir()
        with pytest.raises(SystemExit) as end:
            main(["doctor", "r9", "--run-dir", str(run_dir)])
    assert end.value.code == 2
    assert "no robot 'r9' in the simulation" in capsys.readouterr().err


# -- robots over ssh -------------------------------------------------------------------------------------------------

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="a full disk is a small tmpfs, which needs root to mount")


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[FakeRobots]:
    robots = FakeRobots(tmp_path)
    yield robots
    robots.close()


def real(robots: FakeRobots, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Report]]:
    robots.ready()
    rest = ["--real", "--json", "--config", str(robots.config), "--ssh-config", str(robots.ssh_config)]
    code = doctor.run(parsed([*words, *rest]), Rig(root="root", places=PLACES))
    return code, json.loads(capsys.readouterr().out)


@needs_ssh
def test_a_fresh_pi_is_told_what_it_lacks(robots: FakeRobots, capsys: pytest.CaptureFixture[str]) -> None:
    add_pi(robots, "r0")
    robots.add("r1", up=False)
    code, said = real(robots, capsys)
    assert code == 1
    assert said["problems"] == {"r1": "it runs no ssh server (or another port)"}
    report = said["robots"]["r0"]
    assert report["board"]["state"] == "ok"
    for check in ("packages", "boot", "name", "release", "config", "services"):
        assert report[check]["state"] == "bad", check
    assert report["name"]["remedy"] == "swarm provision r0"


@needs_ssh
def test_a_key_that_others_may_read(robots: FakeRobots, capsys: pytest.CaptureFixture[str]) -> None:
    home = add_pi(robots, "r0")
    robots.config.write_text(robots.config.read_text().replace("insecure = true", ""))
    key = home / "root/etc/swarm/key"
    key.parent.mkdir()
    new_key_file(key, 5.0)
    assert "belongs to" in real(robots, capsys)[1]["robots"]["r0"]["key"]["text"]  # to us, not to the mesh
    key.chmod(0o644)
    _, said = real(robots, capsys)
    assert said["robots"]["r0"]["key"]["text"] == "others may read it (mode 0644)"
    assert said["robots"]["r0"]["key"]["remedy"].startswith("chmod 600 /etc/swarm/key there")
    secret = key.read_text().split()[-1]
    assert secret not in json.dumps(said)


def test_the_doctor_leaves_an_i2c_bus_alone_that_a_process_has(tmp_path: Path) -> None:
    """A balancer that starts has it too: the doctor's transfers would go between its own."""
    (tmp_path / "dev").mkdir()
    device = tmp_path / "dev/i2c-1"
    device.touch()
    with device.open("r+b") as balancer:
        fcntl.flock(balancer, fcntl.LOCK_EX)
        assert examine._devices(str(tmp_path)) is None
    assert examine._devices(str(tmp_path)) == {"problem": "", "imu": None, "atmega": None, "display": False}


@needs_ssh
def test_a_key_at_a_place_of_its_own_is_examined_there(robots: FakeRobots, capsys: pytest.CaptureFixture[str]) -> None:
    home = add_pi(robots, "r0")
    robots.config.write_text(robots.config.read_text().replace("insecure = true", 'key = "/srv/swarm.key"'))
    found = real(robots, capsys)[1]["robots"]["r0"]["key"]
    assert (found["text"], found["remedy"]) == ("it has no key", "copy the key to /srv/swarm.key there")
    key = home / "root/srv/swarm.key"
    key.parent.mkdir()
    new_key_file(key, 5.0)
    assert "belongs to" in real(robots, capsys)[1]["robots"]["r0"]["key"]["text"]


@needs_ssh
@needs_root
def test_the_doctor_names_a_full_disk(robots: FakeRobots, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    home = add_pi(robots, "r0")
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(home / "root")]
    if subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("no tmpfs can be mounted here")
    try:
        _, said = real(robots, capsys)
    finally:
        subprocess.run(["umount", str(home / "root")], check=True)
    assert said["robots"]["r0"]["disk"]["text"] == "2 MB left"
    assert said["robots"]["r0"]["disk"]["state"] == "bad"
    assert "swarm fetch --delete" in said["robots"]["r0"]["disk"]["remedy"]
