"""`swarm deploy` over real ssh servers: what a release brings to each robot, and why it does not come."""

import os
import re
from pathlib import Path

import pytest
from fake_releases import add_python, make_release, sent
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

from laptop.fleet.release.install import read_release
from swarm.config.keyfile import new_key_file
from swarm.errors import LocalError

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh


def test_a_release_is_brought_once(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    home = robots.add("r0")
    add_python(home)
    wheels = {"wheels/big.whl": os.urandom(3_000_000), "wheels/own.whl": b"first"}
    first = make_release(robots.folder / "first.tar.gz", "1-aaa", wheels)
    assert run("deploy", str(first), "--json") == 0
    (outcome,) = outcomes(capsys).values()
    assert str(outcome["text"]).startswith("1-aaa runs as r0")
    whole = sent(outcome)
    assert whole > 3_000_000
    said = (home / "installed").read_text()
    assert re.fullmatch(r"--name r0 --config /\S+/config\n", said)
    assert (home / "config").read_bytes() == robots.config.read_bytes()
    assert not Path(said.split()[-1]).parent.exists()

    assert run("deploy", str(first), "--json") == 0
    assert sent(outcomes(capsys)["r0"]) < whole / 100

    second = make_release(robots.folder / "second.tar.gz", "1-bbb", {**wheels, "wheels/own.whl": b"second"})
    assert run("deploy", str(second), "--json") == 0
    assert sent(outcomes(capsys)["r0"]) < whole / 100
    assert (home / ".cache/balboa-swarm/wheels/own.whl").read_bytes() == b"second"


def test_a_file_of_an_older_release_does_not_stay(robots: FakeRobots, run: Run) -> None:
    home = robots.add("r0")
    add_python(home)
    assert run("deploy", str(make_release(robots.folder / "a.tar.gz", "1-a", {"wheels/old.whl": b"x"}))) == 0
    assert run("deploy", str(make_release(robots.folder / "b.tar.gz", "1-b", {"wheels/new.whl": b"x"}))) == 0
    assert [path.name for path in (home / ".cache/balboa-swarm/wheels").iterdir()] == ["new.whl"]


def test_a_transfer_that_breaks_goes_on_where_it_was(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first robot's disk is full in mid-transfer, the second is well; later the first has room."""
    full = robots.add("r0", hook='case $SSH_ORIGINAL_COMMAND in *tar*) [ -e "$HOME/room" ] || ulimit -f 2000 ;; esac')
    well = robots.add("r1")
    for home in (full, well):
        add_python(home)
    wheels = {"wheels/a.whl": os.urandom(500_000), "wheels/b.whl": os.urandom(3_000_000)}
    release = make_release(robots.folder / "a.tar.gz", "1-a", wheels)
    assert run("deploy", str(release), "--json") == 1
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r1"]["ok"]) == (False, True)
    assert not (full / "installed").exists()
    (full / "room").touch()
    assert run("deploy", str(release), "--json") == 0
    found = outcomes(capsys)
    assert 3_000_000 < sent(found["r0"]) < 3_400_000


TAR = "case $SSH_ORIGINAL_COMMAND in *tar*) {} ;; esac"
ROOM = 'test -e "$HOME/mended" || ulimit -f 2000'
DIES = """test -e "$HOME/mended" || { head -c 500000 >/dev/null; kill -9 $PPID; }"""


@pytest.mark.slow
def test_eight_robots_of_which_four_are_in_trouble(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """One is absent, one's disk is full, one has another host key, one dies in mid-transfer: each is named, the others
    get it, one of them late, and what came of a broken transfer is installed nowhere."""
    well = ["r0", "r2", "r6", "r7"]
    trouble: dict[str, dict[str, object]] = {
        "r1": {"up": False},
        "r2": {"hook": TAR.format("sleep 2")},
        "r3": {"hook": TAR.format(ROOM)},
        "r4": {"known": False},
        "r5": {"hook": TAR.format(DIES)},
    }
    homes = {name: robots.add(name, **trouble.get(name, {})) for name in (f"r{n}" for n in range(8))}
    for home in homes.values():
        add_python(home)
    robots.ready()
    wheels = {"wheels/a.whl": os.urandom(500_000), "wheels/b.whl": os.urandom(3_000_000)}
    release = make_release(robots.folder / "a.tar.gz", "1-a", wheels)
    assert run("deploy", str(release), "--json") == 1
    found = {name: (outcome["ok"], str(outcome["text"])) for name, outcome in outcomes(capsys).items()}
    assert [name for name, (ok, _) in found.items() if ok] == well
    assert found["r1"][1] == "it runs no ssh server (or another port)"
    assert "is its disk full?" in found["r3"][1]
    assert found["r4"][1].startswith("its host key has changed; if set up anew: ssh-keygen -")
    assert "in the middle of it" in found["r5"][1]
    assert [name for name, home in homes.items() if (home / "installed").exists()] == well
    for name in ("r3", "r5"):
        (homes[name] / "mended").touch()
    assert run("deploy", str(release), "--json") == 1
    mended = [name for name, outcome in outcomes(capsys).items() if outcome["ok"]]
    assert mended == [name for name in homes if name not in ("r1", "r4")]
    assert [name for name, home in homes.items() if (home / "installed").exists()] == mended


def test_another_deploy_changes_nothing_of_what_is_installed(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two laptops bring two releases to the folder of one robot. Its install takes a minute, and names what it has
    unpacked by the release."""
    other = "(cd ~/.cache/balboa-swarm && rm wheels/a.whl && echo other >wheels/a.whl && echo other >wheels/b.whl)"
    home = robots.add("r0", hook=f"case $SSH_ORIGINAL_COMMAND in *robot=*) [ ! -e early ] || {other} ;; esac")
    add_python(home)
    install = f"#!/bin/sh\n{other}\ncat wheels/* >$HOME/installed\necho done\n"
    release = make_release(robots.folder / "a.tar.gz", "1-a", {"wheels/a.whl": b"ours"}, install)
    assert run("deploy", str(release)) == 0
    assert (home / "installed").read_text() == "ours"
    (home / "early").touch()
    (home / "installed").unlink()
    capsys.readouterr()
    assert run("deploy", str(release), "--json") == 1
    assert "another deploy runs on this robot" in str(outcomes(capsys)["r0"]["text"])
    assert not (home / "installed").exists()
    assert [path.name for path in (home / ".cache").iterdir()] == ["balboa-swarm"]


def test_a_robot_that_no_release_fits(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    robots.add("r0")
    (robots.folder / "r0/bin/uname").write_text("#!/bin/sh\necho riscv64\n")
    (robots.folder / "r0/bin/uname").chmod(0o755)
    release = make_release(robots.folder / "a.tar.gz", "1-a", {})
    assert run("deploy", str(release), "--json") == 1
    assert "it is riscv64 Python" in str(outcomes(capsys)["r0"]["text"])


def test_what_is_no_release(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    robots.add("r0")
    (robots.folder / "x.tar.gz").write_bytes(b"no tar")
    assert run("deploy", str(robots.folder / "x.tar.gz")) == 2
    assert "no release can be read" in capsys.readouterr().err
    assert run("deploy", "nosuch.tar.gz") == 2
    assert "nosuch.tar.gz: no release can be read: No such file or directory; swarm deploy" in capsys.readouterr().err


def test_a_release_with_a_wrong_byte_is_none(tmp_path: Path) -> None:
    path = make_release(tmp_path / "a.tar.gz", "1-a", {"wheels/a.whl": os.urandom(100_000)})
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(LocalError, match="no release can be read"):
        read_release(path)


def test_an_install_that_fails_says_why(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    add_python(robots.add("r0"))
    bad = make_release(robots.folder / "a.tar.gz", "1-a", {}, "#!/bin/sh\necho 'install: no room' >&2\nexit 1\n")
    assert run("deploy", str(bad), "--json") == 1
    assert outcomes(capsys)["r0"]["text"] == "install: no room"


def test_a_key_that_others_may_read_reaches_no_robot(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    home = robots.add("r0")
    key = robots.folder / "key"
    new_key_file(key, 1)
    key.chmod(0o644)
    release = make_release(robots.folder / "a.tar.gz", "1-a", {})
    assert run("deploy", str(release), "--key", str(key)) == 2
    assert "others than its owner may use it (mode 0644): chmod 600" in capsys.readouterr().err
    assert not (home / ".cache").exists()


def test_a_key_that_the_robots_would_look_for_elsewhere_reaches_no_robot(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """It would be installed, and no link come up."""
    home = robots.add("r0")
    key = robots.folder / "key"
    new_key_file(key, 1)
    robots.config.write_text(robots.config.read_text().replace("insecure = true", 'key = "/srv/swarm.key"'))
    release = make_release(robots.folder / "a.tar.gz", "1-a", {})
    assert run("deploy", str(release), "--key", str(key)) == 2
    said = capsys.readouterr().err
    assert "would become /etc/swarm/key on the robots" in said
    assert "look for /srv/swarm.key: remove that line" in said
    assert not (home / ".cache").exists()


def test_a_host_that_is_another_robot_is_named(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """A config whose hosts are mixed up must not make one robot another."""
    homes = [robots.add(name) for name in ("r0", "r1")]
    for home in homes:
        add_python(home)
    robots.script("r1", "sed", 'case $2 in s/^SWARM_ROBOT*) echo r4 ;; *) exec /usr/bin/sed "$@" ;; esac')
    release = make_release(robots.folder / "a.tar.gz", "1-a", {})
    assert run("deploy", str(release), "--json") == 1
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r1"]["ok"]) == (True, False)
    assert found["r1"]["text"] == (
        "the robot at r1 says that it is r4: correct `host` in swarm.toml, or swarm deploy --rename makes it r1"
    )
    assert not (homes[1] / "installed").exists()
    assert run("deploy", str(release), "--rename") == 0
    assert (homes[1] / "installed").exists()


def test_a_robot_with_another_python_is_named(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    home = robots.add("r0", hook="PATH=$HOME/bin:$HOME/tools")
    tools = home / "tools"
    tools.mkdir()
    for name in ("sh", "uname", "sed", "tar", "cat", "sha256sum", "find", "mkdir", "true"):
        (tools / name).symlink_to(f"/usr/bin/{name}")
    release = make_release(robots.folder / "a.tar.gz", "1-a", {})
    assert run("deploy", str(release), "--json") == 1
    machine = os.uname().machine
    said = f"it is {machine} without any Python that we know, the releases are for {machine} Python 3.11: swarm deploy"
    assert str(outcomes(capsys)["r0"]["text"]).startswith(said)


def test_a_robot_that_does_not_let_us_in_is_named(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r0")
    (robots.folder / "id").rename(robots.folder / "lost")
    assert run("command", "true", "--json") == 1
    assert str(outcomes(capsys)["r0"]["text"]).startswith("it takes none of your ssh keys: ssh-copy-id r0")
