"""`swarm provision` against real ssh servers whose robots are Raspberry Pis by their files and commands only."""

import io
import json
import os
import tarfile
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fake_pis import PLACES, add_pi, make_bundle
from fake_robots import FakeRobots
from needs import needs_ssh

from laptop.cli.robots import provision
from laptop.fleet.provision import Rig
from swarm.config.keyfile import new_key_file

pytestmark = [pytest.mark.slow, needs_ssh]

ALL = "python3-bluez python3-venv bluez-firmware linux-image-rpi-v8"
INSTALL = """#!/bin/sh
[ -e $HOME/runs ] && { echo "install: 1-a runs already as r0; nothing to do"; exit 0; }
touch $HOME/runs
echo "install: 1-a runs as $2"
"""

Provision = Callable[..., tuple[int, dict[str, list[str]], dict[str, str]]]


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[FakeRobots]:
    robots = FakeRobots(tmp_path)
    yield robots
    robots.close()


@pytest.fixture
def run(robots: FakeRobots, capsys: pytest.CaptureFixture[str]) -> Provision:
    """Exit code, then by robot the steps' lines and the outcome."""

    def swarm(*arguments: str) -> tuple[int, dict[str, list[str]], dict[str, str]]:
        robots.ready()
        over_bluetooth(robots.config)
        parser = ArgumentParser()
        provision.add_arguments(parser)
        common = ["--json", "--config", str(robots.config), "--ssh-config", str(robots.ssh_config)]
        # All robots of these tests have their homes side by side; `~` would be the same for all of them.
        rig = Rig(root="root", places=PLACES, ask_s=0.05)
        code = provision.run(parser.parse_args([*arguments, *common]), rig)
        rows = json.loads(capsys.readouterr().out)["robots"]
        return code, {name: row["lines"] for name, row in rows.items()}, {n: row["text"] for n, row in rows.items()}

    return swarm


def over_bluetooth(config: Path) -> None:
    """The robots' links are Bluetooth's, not TCP's."""
    lines = config.read_text().splitlines()
    count = (f"{n:02X}" for n in range(len(lines)))
    lines = [f'bluetooth = "B8:27:EB:00:00:{next(count)}"' if line[:4] == "link" else line for line in lines]
    config.write_text("\n".join(lines) + "\n")


def add_release(folder: Path) -> None:
    files = {"ID": b"1-a", "FOR": f"{os.uname().machine} 3.11".encode(), "install": INSTALL.encode()}
    with tarfile.open(folder / "balboa-swarm-1-a.tar.gz", "w:gz") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(f"balboa-swarm-1-a/{name}")
            entry.size, entry.mode = len(data), 0o755
            archive.addfile(entry, io.BytesIO(data))


def add_python(home: Path) -> None:
    (home / "bin/python3.11").write_text("#!/bin/sh\n")
    (home / "bin/python3.11").chmod(0o755)


def states(lines: list[str]) -> dict[str, str]:
    """The state of each step, of lines `step: state: text`."""
    parts = [line.split(": ", 2) for line in lines]
    return {part[0]: part[1] for part in parts if len(part) == 3}


def tree(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_a_fresh_pi_becomes_a_robot_and_stays_one(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0", kernel="6.1.21-v8+")
    add_python(home)
    bundle = make_bundle(robots.folder / "bundle", ALL)
    add_release(bundle)
    code, lines, text = run("--bundle", str(bundle))
    assert code == 0, lines
    assert states(lines["r0"]) == {
        "board": "ok", "system": "ok", "disk": "ok", "key": "ok", "address": "ok", "clock": "ok",
        "packages": "changed", "kernel": "changed", "boot": "changed", "cmdline": "changed", "i2c": "changed",
        "radio": "changed", "bluetooth": "changed", "realtime": "changed", "network": "changed", "name": "changed",
        "reboot": "changed", "release": "changed",
    }  # fmt: skip
    root = home / "root"
    assert (root / "etc/hostname").read_text() == "r0\n"
    assert "dtparam=i2c_arm_baudrate=100000\n" in (root / "boot/firmware/config.txt").read_text()
    assert "core_freq=400\ncore_freq_min=400\n" in (root / "boot/firmware/config.txt").read_text()
    assert (root / "boot/firmware/config.txt").read_text().startswith("# For more options")
    words = (root / "boot/firmware/cmdline.txt").read_text().split()
    assert "cgroup_enable=memory" in words
    assert "root=PARTUUID=1-02" in words
    assert "console=serial0,115200" not in words  # a DWM1001 may be wired there: swarm.toml's default
    brcm = root / "lib/firmware/brcm"
    assert str((brcm / "BCM43430B0.raspberrypi,model-zero-2-w.hcd").readlink()) == "../synaptics/SYN43430B0.hcd"
    main_conf = (root / "etc/bluetooth/main.conf").read_text()
    assert {"AutoEnable = true", "[BR]", "PageScanInterval = 512"} <= set(main_conf.splitlines())
    assert (root / "sys/class/rfkill/rfkill0/soft").read_text() == "0\n"
    assert "127.0.1.1\tr0\n" in (root / "etc/hosts").read_text()

    before, log = tree(root), (home / "log").read_text()
    code, lines, text = run("--bundle", str(bundle))
    assert (code, text["r0"]) == (0, "0 steps changed, all others were ok")
    assert set(states(lines["r0"]).values()) == {"ok"}
    assert tree(root) == before
    only_looks = [line for line in (home / "log").read_text().removeprefix(log).splitlines() if " show " not in line]
    assert only_looks == []


def test_without_their_addresses_robots_are_made_ready_for_pairing(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill")
    add_pi(robots, "r1", packages="bluez python3 python3-bluez python3-venv rfkill")
    lines = robots.config.read_text().splitlines()
    robots.config.write_text("\n".join(line for line in lines if line[:4] != "link") + "\n")
    code, _, text = run()
    assert code == 0
    assert "no release yet: swarm pair first (swarm.toml lacks the Bluetooth address of r0 r1)" in text["r0"]
    assert (home / "root/etc/hostname").read_text() == "r0\n"


def test_a_dry_run_says_it_all_and_touches_nothing(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0")
    before = tree(home)
    bundle = make_bundle(robots.folder / "bundle", ALL)
    code, lines, text = run("--check", "--bundle", str(bundle))
    assert code == 0
    assert states(lines["r0"])["name"] == "would change"
    assert text["r0"] == "9 of 16 would be changed, and it would reboot"
    after = tree(home)
    assert {name for name in after if after[name] != before.get(name)} == {"log"}


def test_each_robot_is_named_for_what_it_is_and_the_others_go_on(robots: FakeRobots, run: Provision) -> None:
    homes = {
        "r0": add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill"),
        "r1": add_pi(robots, "r1", model="Raspberry Pi 3 Model B Plus Rev 1.3"),
        "r2": add_pi(robots, "r2", model="Raspberry Pi 4 Model B Rev 1.5"),
        "r3": add_pi(robots, "r3", suite="bullseye"),
        "r4": add_pi(robots, "r4"),
        "r5": add_pi(robots, "r5", kernel="6.1.21-v8+"),
        "r6": add_pi(robots, "r6"),
        "r7": add_pi(robots, "r7"),
    }
    robots.add("r8", up=False)
    (homes["r4"] / "architecture").write_text("armhf\n")
    (homes["r6"] / "bin/sudo").write_text("#!/bin/sh\necho 'sudo: a password is required' >&2; exit 1\n")
    (homes["r7"] / "bin/python3").write_text("#!/bin/sh\necho 'sh: 1: python3: not found' >&2; exit 127\n")
    (homes["r7"] / "bin/python3").chmod(0o755)
    before = {name: tree(home / "root") for name, home in homes.items()}
    code, _, text = run()
    assert code == 1
    assert text["r0"].startswith("8 steps changed; no release was given")
    assert text["r1"].startswith("board: Raspberry Pi 3 Model B Plus Rev 1.3: robots are Raspberry Pi Zero 2 W or ")
    assert 'but swarm.toml says board = "zero2w" of r2' in text["r2"]
    assert text["r3"].startswith("system: bullseye: flash Raspberry Pi OS Lite (64 bit)")
    assert text["r4"].startswith("system: its programs are armhf, not arm64: flash")
    assert "6.1.21-v8+ may crash when a robot calls one that is absent; 6.12 is needed" in text["r5"]
    assert "without python3-bluez python3-venv, and no bundle for bookworm" in text["r5"]
    assert text["r6"].startswith("its user may not use sudo without a password")
    assert text["r7"].startswith("it has no python3: flash")
    assert text["r8"] == "it runs no ssh server (or another port)"
    assert all(tree(homes[name] / "root") == before[name] for name in homes if name != "r0")


def test_a_key_is_needed_where_links_are_authenticated(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill")
    robots.config.write_text(robots.config.read_text().replace("insecure = true", ""))
    _, _, text = run()
    assert text["r0"] == "key: it has no key of the swarm, and none was given: --key FILE (swarm key new makes one)"
    new_key_file(robots.folder / "key", 1.0)
    assert run("--key", str(robots.folder / "key"))[0] == 0
    assert (home / "root/etc/hostname").read_text() == "r0\n"


def test_a_key_at_a_place_of_its_own_is_looked_for_there(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill")
    robots.config.write_text(robots.config.read_text().replace("insecure = true", 'key = "/srv/swarm.key"'))
    key = home / "root/srv/swarm.key"
    _, _, text = run()
    assert text["r0"] == (
        "key: it has no /srv/swarm.key, which [mesh] key names: copy the key there, or remove that line"
    )
    key.parent.mkdir()
    new_key_file(key, 1.0)
    code, lines, _ = run()
    assert (code, states(lines["r0"])["key"]) == (0, "ok")


def test_an_address_that_its_new_name_would_change(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0")
    with robots.ssh_config.open("r+") as file:
        text = file.read()
        file.seek(0)
        file.write(text.replace("Host r0\n", "Host r0 raspberrypi.local\n"))
    _, _, text = run("r0=raspberrypi.local")
    assert "address: raspberrypi.local will be r0.local once it has its name" in text["r0"]
    assert (home / "root/etc/hostname").read_text() == "raspberrypi\n"


def test_half_installed_packages_are_finished_first(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0")
    (home / "audit").write_text("The following packages are only half configured:\n python3-venv  venv\n")
    bundle = make_bundle(robots.folder / "bundle", ALL)
    assert run("--bundle", str(bundle))[0] == 0
    said = (home / "log").read_text()
    assert said.index("dpkg --configure -a") < said.index("apt python3-bluez")


def test_a_bundle_that_was_damaged_changes_nothing(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0")
    bundle = make_bundle(robots.folder / "bundle", ALL)
    (bundle / "bookworm-arm64/python3-venv.deb").write_bytes(b"something else")
    before = tree(home / "root")
    code, _, text = run("--bundle", str(bundle))
    assert code == 1
    assert "python3-venv.deb: is not what the index says; make the bundle anew" in text["r0"]
    after = {path: data for path, data in tree(home / "root").items() if "var/cache" not in path}
    assert after == before


def test_a_bundle_that_lacks_a_package_changes_nothing(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0")
    before = tree(home / "root")
    code, _, text = run("--bundle", str(make_bundle(robots.folder / "bundle", "python3-bluez")))
    assert code == 1
    assert "Unable to locate package python3-venv" in text["r0"]
    after = {path: data for path, data in tree(home / "root").items() if "var/cache" not in path}
    assert after == before


def test_a_full_disk_in_mid_transfer(robots: FakeRobots, run: Provision) -> None:
    hook = 'case $SSH_ORIGINAL_COMMAND in *"tar --extract"*) [ -e "$HOME/room" ] || ulimit -f 0 ;; esac'
    home = add_pi(robots, "r0", hook=hook)
    bundle = make_bundle(robots.folder / "bundle", ALL)
    code, _, text = run("--bundle", str(bundle))
    assert code == 1
    assert "not all arrived: is its disk full?" in text["r0"]
    assert "apt" not in (home / "log").read_text()
    (home / "room").touch()
    assert run("--bundle", str(bundle))[0] == 0


def test_a_change_that_does_not_hold_is_no_success(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill")
    (home / "bin/rfkill").write_text("#!/bin/sh\ntrue\n")
    code, lines, text = run()
    assert code == 1
    assert text["r0"].startswith("bluetooth: the change did not hold")
    assert states(lines["r0"])["bluetooth"] == "failed"


def test_the_reboot_may_be_left_to_others(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill")
    code, _, text = run("--no-reboot")
    assert code == 0
    assert text["r0"] == "8 steps changed; reboot it, then provision it again"
    assert "systemctl reboot" not in (home / "log").read_text()


def test_provisioning_lets_a_robot_join_a_wireless_network(robots: FakeRobots, run: Provision) -> None:
    home = add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill")
    (home / "bin/nmcli").write_text('#!/bin/sh\necho "nmcli $*" >> $HOME/log\n')
    (home / "bin/nmcli").chmod(0o755)
    (robots.folder / "password").write_text(" a\\b secret\n")
    arguments = ("--wifi", "swarm net", "--wifi-password", str(robots.folder / "password"))
    assert run(*arguments)[0] == 0
    path = home / "root/etc/NetworkManager/system-connections/swarm.nmconnection"
    assert path.stat().st_mode & 0o777 == 0o600
    assert "\npsk=\\sa\\\\b secret\n" in path.read_text()
    assert run(*arguments)[2]["r0"].startswith("0 steps changed")


def test_a_reboot_that_was_left_out_is_made_up_for(robots: FakeRobots, run: Provision) -> None:
    """An earlier run may have been broken off behind its changes: the files are right, and not in force."""
    home = add_pi(robots, "r0", packages="bluez python3 python3-bluez python3-venv rfkill")
    assert run("--no-reboot")[0] == 0
    assert (home / "log").read_text().count("systemctl reboot") == 0
    assert run("--check")[2]["r0"].startswith("0 of ")
    assert run("--check")[2]["r0"].endswith(" would be changed, and it would reboot")
    for _ in range(2):
        run()
        assert (home / "log").read_text().count("systemctl reboot") == 1
    assert run("--check")[2]["r0"].endswith(" would be changed")
