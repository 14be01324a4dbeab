"""`swarm flash` over ssh: what each robot is told to run, and what it says."""

from pathlib import Path

import pytest
from fake_robots import FakeRobots, outcomes
from needs import needs_ssh

from laptop.cli import main
from services.balancer.core.devices import balboa
from services.balancer.core.flashing import image

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh


@pytest.fixture
def firmware(tmp_path: Path) -> Path:
    data = image.MARK + image.SIGNATURE + bytes((balboa.LAYOUT_VERSION, 7))
    record = bytes((len(data), 0, 0, 0)) + data
    path = tmp_path / "balboa.hex"
    path.write_text(f":{(record + bytes((-sum(record) % 256,))).hex()}\n:00000001FF\n")
    return path


def run(robots: FakeRobots, *arguments: str) -> int:
    robots.ready()
    fleet = ["--config", str(robots.config), "--ssh-config", str(robots.ssh_config)]
    with pytest.raises(SystemExit) as end:
        main(["flash", *arguments, *fleet])
    return int(str(end.value.code))


def test_every_robot_flashes_its_own(robots: FakeRobots, firmware: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("r0", "r1"):
        robots.add(name)
        robots.script(name, "sudo", 'printf "%s\\n" "$*" > $HOME/asked; cat > $HOME/got; echo "50 %"; echo "100 %"')
    robots.script("r1", "sudo", "cat > /dev/null; echo 'swarm: no bootloader has come to a USB port' >&2; exit 1")
    assert run(robots, str(firmware), "--json") == 1
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r0"]["text"]) == (True, "revision 7 runs")
    assert found["r0"]["lines"] == ["50 %", "100 %"]
    assert (found["r1"]["ok"], found["r1"]["text"]) == (False, "no bootloader has come to a USB port")
    home = robots.folder / "r0"
    assert (home / "asked").read_text() == "-n env SWARM_ROBOT=r0 /opt/swarm/current/bin/swarm flash - --here\n"
    assert (home / "got").read_text() == firmware.read_text()


def test_a_wrong_file_reaches_no_robot(robots: FakeRobots, firmware: Path, capsys: pytest.CaptureFixture[str]) -> None:
    home = robots.add("r0")
    robots.script("r0", "sudo", "touch $HOME/asked")
    firmware.write_text(firmware.read_text().replace("\n:00000001FF", ""))
    assert run(robots, str(firmware)) == 2
    assert "balboa.hex: no end: the file is not whole" in capsys.readouterr().err
    assert run(robots, "missing.hex") == 2
    assert "missing.hex cannot be read" in capsys.readouterr().err
    assert not (home / "asked").exists()


def test_flash_without_a_file_sends_the_firmware_of_this_release(robots: FakeRobots) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", "cat > $HOME/got")
    assert run(robots) == 0
    found = image.read((robots.folder / "r0/got").read_text())
    assert found.layout == balboa.LAYOUT_VERSION
