"""Commands for all robots, over real ssh servers: every robot has its outcome, none waits for another."""

import io
import json
import os
import re
import tarfile
from pathlib import Path

import pytest
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

from laptop.cli.robots import status
from laptop.fleet.ssh.everyone import RobotOutcome
from services.balancer.core import faults
from swarm.config.keyfile import new_key_file

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh


def test_a_command_runs_on_every_robot(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("r0", "r1", "r2"):
        robots.add(name)
    assert run("command", "basename $HOME; echo more") == 0
    said = capsys.readouterr().out
    assert all(f"{name}: {name}\n" in said and f"{name}: more\n" in said for name in ("r0", "r1", "r2"))
    assert run("command", "test $(basename $HOME) != r1 || { echo broken >&2; exit 3; }", "--json") == 1
    found = outcomes(capsys)
    assert [found[name]["ok"] for name in ("r0", "r1", "r2")] == [True, False, True]
    assert found["r1"]["text"] == "exit code 3: broken"


def test_only_the_robots_that_are_named(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("r0", "r1", "r2"):
        robots.add(name)
    assert run("command", "true", "--robots", "r2,r0", "--json") == 0
    assert sorted(outcomes(capsys)) == ["r0", "r2"]
    assert run("command", "true", "--robots", "r9") == 2
    assert "r9 is no robot of" in capsys.readouterr().err


def test_what_is_wrong_is_named_and_the_others_go_on(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r0")
    robots.add("r1", up=False)
    robots.add("r2", known=False)
    robots.add("r3", hook="kill -9 $PPID")
    robots.add("r4", hook="echo $$ > hung; exec sleep 1000")
    assert run("command", "echo here", "--robots", "r0,r1,r2,r3", "--json") == 1
    found = {name: str(outcome["text"]) for name, outcome in outcomes(capsys).items()}
    assert found["r0"] == ""
    assert found["r1"] == "it runs no ssh server (or another port)"
    assert found["r2"] == "its host key has changed; if set up anew: ssh-keygen -R r2"
    assert "in the middle of it" in found["r3"]
    assert run("command", "echo here", "--robots", "r4", "--timeout", "5", "--json") == 1
    assert outcomes(capsys)["r4"]["text"] == "not done within 5 s (--timeout)"


def test_services_are_started_by_their_names(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    home = robots.add("r0")
    assert run("services", "restart", "mesh", "consensus") == 0
    assert run("services", "start") == 0
    assert run("services", "stop", "dwm") == 0
    assert (home / "systemctl.log").read_text().splitlines() == [
        "restart swarm-mesh.service swarm-app@consensus.service",
        "start swarm.target",
        "stop swarm-dwm.service",
    ]
    assert run("services", "stop", "No Such") == 2
    assert "'No Such': expected bus, mesh, balancer, dwm or the name of an app" in capsys.readouterr().err


# -- deploy ------------------------------------------------------------------------------------------------------

INSTALL = """#!/bin/sh
echo "$@" >> $HOME/installed
cat "$4" > $HOME/config
echo "install: $(cat ID) runs as $2"
"""


def make_release(path: Path, identity: str, wheels: dict[str, bytes], install: str = INSTALL) -> Path:
    machine, python = os.uname().machine, "3.11"
    files = {"ID": identity.encode(), "FOR": f"{machine} {python}".encode(), "install": install.encode(), **wheels}
    with tarfile.open(path, "w:gz") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(f"balboa-swarm-{identity}/{name}")
            entry.size, entry.mode = len(data), 0o755 if name == "install" else 0o644
            archive.addfile(entry, io.BytesIO(data))
    return path


def add_python(home: Path) -> None:
    python = home / "bin/python3.11"
    python.write_text("#!/bin/sh\n")
    python.chmod(0o755)


def sent(outcome: dict[str, object]) -> int:
    return int(str(outcome["text"]).rpartition("(")[2].split()[0])


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
    assert found["r4"][1] == "its host key has changed; if set up anew: ssh-keygen -R r4"
    assert "in the middle of it" in found["r5"][1]
    assert [name for name, home in homes.items() if (home / "installed").exists()] == well
    for name in ("r3", "r5"):
        (homes[name] / "mended").touch()
    assert run("deploy", str(release), "--json") == 1
    mended = [name for name, outcome in outcomes(capsys).items() if outcome["ok"]]
    assert mended == [name for name in homes if name not in ("r1", "r4")]
    assert [name for name, home in homes.items() if (home / "installed").exists()] == mended


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
    assert found["r1"]["text"] == ("at r1 is r4 by its own word: mend `host` in swarm.toml, or --rename makes it r1")
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
    assert outcomes(capsys)["r0"]["text"] == "it takes none of your ssh keys: ssh-copy-id r0"


# -- run ---------------------------------------------------------------------------------------------------------

PATHS = "s#/etc/swarm#etc#g; s#/var/lib/swarm#lib#g"


def add_robot(
    robots: FakeRobots, name: str, release: str = "1-a", revision: int = 1, config: bytes = b"", own: str = ""
) -> Path:
    """A robot that says what it runs, with the system's folders in its home."""
    home = robots.add(name)
    (home / "etc/apps").mkdir(parents=True)
    (home / "lib/apps").mkdir(parents=True)
    (home / "config").write_bytes(config)
    robots.script(name, "sed", f'case $2 in s/^SWARM_ROBOT*) echo {own} ;; *) exec /usr/bin/sed "$@" ;; esac')
    robots.script(name, "readlink", f"echo /opt/swarm/releases/{release}")
    # The config of the others is the one here, which is complete when all robots are added.
    robots.script(name, "sha256sum", f"[ -s $HOME/config ] || exec /usr/bin/sha256sum {robots.config}; echo {'0' * 64}")
    firmware = f'{{"key": "k", "value": {{"layout": 1, "revision": {revision}}}}}'
    text = f"shift; case $1 in */z_sub) echo '{firmware}' ;; "
    text += f'*) exec "$1" "$2" "$(printf \'%s\\n\' "$3" | sed \'{PATHS}\')" ;; esac'
    robots.script(name, "sudo", text)
    return home


def files(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_an_app_is_started_with_one_number_for_all(robots: FakeRobots, run: Run) -> None:
    homes = [add_robot(robots, name) for name in ("r0", "r1")]
    app = robots.folder / "mine.py"
    app.write_text("class Mine: ...\n")
    assert run("run", str(app), "--iterations", "50", "--set", "gain=0.5", "--set", "r1.value=3") == 0
    (code,) = files(homes[0] / "lib")
    assert re.fullmatch(r"apps/mine-[0-9a-f]{12}/mine\.py", code)
    assert files(homes[0] / "lib") == files(homes[1] / "lib") == {code: "class Mine: ...\n"}
    assert files(homes[0] / "etc") == files(homes[1] / "etc")
    said = files(homes[0] / "etc")["apps/mine.env"]
    assert said.startswith(f"APP=/var/lib/swarm/{code.removeprefix('lib/')}\nARGUMENTS=--run ")
    arguments = r"^ARGUMENTS=--run [0-9a-f]{16} --record --iterations 50 --set gain=0.5 --set r1.value=3$"
    assert re.search(arguments, said, re.M)
    assert (homes[0] / "systemctl.log").read_text() == "restart --no-block swarm-app@mine.service\n"

    app.write_text("class Other: ...\n")
    assert run("run", str(app)) == 0
    assert list(files(homes[0] / "lib").values()) == ["class Other: ...\n"]
    assert run("run", "consensus", "--no-record") == 0
    said = files(homes[0] / "etc")["apps/consensus.env"]
    assert re.fullmatch(r"APP=consensus\nARGUMENTS=--run [0-9a-f]{16}\n", said)


def test_an_app_goes_with_the_modules_beside_it_and_settings_with_spaces_arrive_whole(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    home = add_robot(robots, "r0")
    app = robots.folder / "mine.py"
    app.write_text("import numpy\nfrom helper import h\nclass Mine: ...\n")
    (robots.folder / "helper").mkdir()
    (robots.folder / "helper/__init__.py").write_text("from other import h\n")
    (robots.folder / "other.py").write_text("h = 1\n")
    (robots.folder / "unused.py").write_text("")
    arguments = ("--algorithm", "fast", "--set", "text=a 'b'", "--set", "led_sync/gain=2", "--step-size", "4e-6")
    assert run("run", str(app), "led_sync", *arguments) == 0
    assert f"warning: {app}, line 1: import of numpy: robots lack it" in capsys.readouterr().err
    sent = {name.partition("/")[2].partition("/")[2] for name in files(home / "lib")}
    assert sent == {"mine.py", "helper/__init__.py", "other.py"}
    said = files(home / "etc")["apps/mine.env"]
    assert " --set algorithm=fast --set step_size=0.04 --escaped text=a%20%27b%27" in said
    assert said.endswith("\n")
    assert files(home / "etc")["apps/led_sync.env"].endswith(" --set gain=2\n")
    (before,) = {name.split("/")[1] for name in files(home / "lib")}
    (robots.folder / "other.py").write_text("h = 2\n")
    assert run("run", str(app)) == 0
    (after,) = {name.split("/")[1] for name in files(home / "lib")}
    assert before != after  # the digest is of all of it


def test_run_names_the_robot_whose_app_has_no_first_state_with_its_last_words(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    homes = [add_robot(robots, name) for name in ("r0", "r1")]
    (homes[1] / "state").write_text("failed\n")
    for name in ("r0", "r1"):
        robots.script(name, "journalctl", "echo first; echo 'ModuleNotFoundError: No module named numpy'")
        text = (
            (robots.folder / name / "bin/sudo").read_text().replace("case $1 in", "case $1 in journalctl) exec $* ;;")
        )
        (robots.folder / name / "bin/sudo").write_text(text)
    assert run("run", "consensus", "--json") == 1
    found = outcomes(capsys)
    assert found["r0"]["text"] == "swarm-app@consensus.service runs"
    assert found["r1"]["text"] == (
        "swarm-app@consensus.service has failed: first | ModuleNotFoundError: No module named numpy"
    )


def test_a_start_that_breaks_changes_nothing(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """The disk is full when the app comes; what ran before is still what would run again."""
    homes = [add_robot(robots, name) for name in ("r0", "r1")]
    app = robots.folder / "mine.py"
    app.write_text("# first\n")
    assert run("run", str(app)) == 0
    before = files(homes[0] / "lib"), files(homes[0] / "etc")
    robots.script("r0", "head", "echo 'head: write error: No space left on device' >&2; exit 1")
    app.write_text("# second\n" * 1000)
    capsys.readouterr()
    assert run("run", str(app), "--json") == 1
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r1"]["ok"]) == (False, True)
    assert "No space left on device" in str(found["r0"]["text"])
    now = {name: text for name, text in files(homes[0] / "lib").items() if ".new/" not in name}
    assert (now, files(homes[0] / "etc")) == before
    assert (homes[0] / "systemctl.log").read_text().count("restart") == 1


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ({"release": "1-b"}, "different releases (r0 1-a, r1 1-b): swarm deploy the same"),
        ({"revision": 2}, "different firmware (r0 revision 1 (layout 1), r1 revision 2 (layout 1)): swarm flash"),
        ({"own": "r4"}, "other names than in swarm.toml (r1 r4): mend `host` there"),
        ({"config": b"other"}, "another swarm.toml than here (r1): swarm deploy brings this one"),
    ],
)
def test_robots_that_differ_run_nothing(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], odd: dict[str, object], said: str
) -> None:
    homes = [add_robot(robots, "r0"), add_robot(robots, "r1", **odd)]
    assert run("run", "consensus") == 2
    assert said in capsys.readouterr().err
    assert not any(files(home / "etc") for home in homes)
    assert run("run", "consensus", "--force") == 0
    assert all(files(home / "etc") for home in homes)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["mesh"], "expected the name of an app"),
        (["missing.py"], "the app cannot be read: No such file"),
        (["consensus", "--iterations", "-1"], "expected 0 or more"),
        (["consensus", "--set", "value"], "'value' is not a setting"),
        (["consensus", "--set", "r9.value=1"], "the robots are r0"),
        (["consensus", "--set", "led_sync/value=1"], "there is no app 'led_sync', but consensus"),
    ],
)
def test_what_cannot_be_run_reaches_no_robot(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], arguments: list[str], problem: str
) -> None:
    home = add_robot(robots, "r0")
    assert run("run", *arguments) == 2
    assert problem in capsys.readouterr().err
    assert files(home / "etc") == {}


def test_a_robot_without_a_release_says_so(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    add_robot(robots, "r0")
    add_robot(robots, "r1")
    robots.script("r1", "readlink", "exit 1")
    robots.script("r1", "sudo", "echo 'sh: 1: cannot create /etc/swarm/apps/x: No such file' >&2; exit 1")
    assert run("run", "consensus", "--json") == 1
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r1"]["ok"]) == (True, False)


# -- status ------------------------------------------------------------------------------------------------------

ANSWER = """== release
/opt/swarm/releases/0.1.0-abc
== units
swarm-app@consensus.service loaded active running Balboa Swarm: the app consensus
swarm-balancer.service loaded active running Balboa Swarm: the balancer
swarm-bus.service loaded active running Balboa Swarm: the bus
swarm-mesh.service loaded failed failed Balboa Swarm: the mesh
== runs
312000000	/var/lib/swarm/runs
== bus
{"key": "swarm/r0/balancer/state", "value": {"mode": "balancing", "battery": 7.4, "battery_left": 9000, "fault": ""}}
{"key": "swarm/r0/balancer/firmware", "value": {"layout": 1, "revision": 4}}
{"key": "swarm/r0/mesh/links", "value": {"links": [{"peer": "r1", "state": "up"}, {"peer": "r2", "state": "down"}]}}
{"key": "swarm/r0/dwm/pose", "value": {"x": 1.5, "y": 2.0, "quality": 90}}
{"key": "swarm/r0/app/consensus/progress", "value": {"phase": "running", "k": 12}}
{"key": "swarm/r0/app/consensus/sync/x", "hex": "00"}
{"key": "swarm/r0/dwm/po
"""


def test_the_status_of_a_robot_is_read() -> None:
    row = status.parse("r0", ANSWER)
    assert row == status.StatusRow(
        release="0.1.0-abc",
        firmware="1.4",
        failed=["dwm", "mesh"],
        battery_v=7.4,
        battery_left_s=9000,
        mode="balancing",
        fault=None,
        next=None,
        links={"r1": "up", "r2": "down"},
        clashes=[],
        pose=[1.5, 2.0],
        apps={"consensus": {"phase": "running", "k": 12}},
        recorded=312_000_000,
        misunderstood=[],
    )


def test_the_status_has_a_row_for_each_robot() -> None:
    rows = {"r0": status.parse("r0", ANSWER)}
    head, row = status.table([RobotOutcome("r0", True, "", 1.0)], rows, 2e9)
    assert head.split() == [
        "robot",
        "services",
        "battery",
        "body",
        "links",
        "pose",
        "apps",
        "recordings",
        "release",
        "firmware",
    ]
    assert row == (
        "r0     not running: dwm mesh  7.4 V 2 h 30 min  balancing  1 of 2  1.50 2.00  "
        "consensus:running@12  312.0 MB of 2.00 GB  0.1.0-abc  1.4"
    )


@pytest.mark.parametrize(
    ("mode", "fault", "stopped", "body"),
    [
        ("idle", "", False, "idle, no fault: swarm balance stand"),
        ("fault", "stopped", True, "stopped: take the stop back (swarm arm), then swarm balance stand"),
        ("fault", "stopped", False, "stopped: swarm balance stand"),
        ("fault", "fell", False, "fell: swarm balance stand: it stands up from front or back by itself"),
        ("balancing", "", False, "balancing"),
    ],
)
def test_the_status_says_what_makes_a_robot_stand(mode: str, fault: str, stopped: bool, body: str) -> None:
    said = [
        {"key": "swarm/r0/balancer/state", "value": {"mode": mode, "fault": fault}},
        {"key": "swarm/r0/balancer/fault", "value": {"name": fault, "recovery": faults.RECOVERY.get(fault, "")}},
    ]
    if stopped:
        said.append({"key": "swarm/r0/mesh/stopped", "value": {"stopped": True}})
    answer = "== bus\n" + "\n".join(map(json.dumps, said))
    rows = {"r0": status.parse("r0", answer)}
    assert body in re.split("  +", status.table([RobotOutcome("r0", True, "", 1.0)], rows, 2e9)[1])


def test_a_robot_that_is_away_has_its_row_too(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    robots.add("r0")
    robots.add("r1", up=False)
    assert run("status") == 1
    rows = capsys.readouterr().out.splitlines()
    assert rows[1].startswith("r0     not running: balancer bus dwm mesh")
    assert rows[2] == "r1     it runs no ssh server (or another port)"
