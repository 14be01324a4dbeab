"""Commands for all robots, over real ssh servers: every robot has its outcome, none waits for another."""

import re
from typing import Any

import pytest
from fake_releases import add_python, make_release
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

from laptop.fleet.ssh import everyone

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


def test_a_command_without_words_is_refused(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    robots.add("r0", up=False)
    assert run("command", " ") == 2
    assert "there is no command in the quotes" in capsys.readouterr().err


def test_a_wireless_password_that_is_no_text_is_refused_and_not_shown(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r0", up=False)
    (robots.folder / "password").write_bytes(b"secret\xff")
    assert run("provision", "--wifi", "net", "--wifi-password", str(robots.folder / "password")) == 2
    said = capsys.readouterr().err
    assert "the password of net cannot be read: it is not UTF-8" in said
    assert "secret" not in said


def test_only_the_robots_that_are_named(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("r0", "r1", "r2"):
        robots.add(name)
    assert run("command", "true", "--robots", "r2,r0", "--json") == 0
    assert sorted(outcomes(capsys)) == ["r0", "r2"]
    assert run("command", "true", "--robots", "r9") == 2
    assert "r9 is no robot of" in capsys.readouterr().err


def test_logs_are_those_that_root_may_read(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """A user of no group for it would see no entry, and no error."""
    robots.add("r0")
    robots.script("r0", "sudo", 'shift; ROOT=1 exec "$@"')
    robots.script("r0", "journalctl", 'echo "${ROOT:+an entry}"')
    assert run("logs", "mesh") == 0
    assert "r0: an entry\n" in capsys.readouterr().out


def test_a_service_that_has_logged_nothing_is_named(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such as a misspelled one: journalctl itself succeeds, and prints a line that is none of the journal."""
    robots.add("r0")
    robots.script("r0", "journalctl", 'case "$*" in *--quiet*) ;; *) echo "-- No entries --" ;; esac')
    assert run("logs", "mehs", "--json") == 0
    outcome = outcomes(capsys)["r0"]
    assert (outcome["lines"], outcome["text"]) == ([], "nothing is logged there by mehs")


def test_one_computer_is_not_made_two_robots(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("r0", "r1"):
        robots.add(name, up=False)
    assert run("provision", "r0=pi@10.0.0.9", "r1=10.0.0.9", "--check") == 2
    assert "r0 and r1 would be the same computer, 10.0.0.9" in capsys.readouterr().err
    assert run("provision", "r0=r1", "r1=R1", "--check") == 2


def test_a_host_that_ssh_would_take_for_an_option_is_refused(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r0", up=False)
    assert run("provision", "r0=-oProxyCommand=id", "--check") == 2
    assert "'-oProxyCommand=id': expected a host as ssh knows it" in capsys.readouterr().err


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
    assert found["r2"].startswith("its host key has changed; if set up anew: ssh-keygen -")
    assert "in the middle of it" in found["r3"]
    assert run("command", "echo here", "--robots", "r4", "--timeout", "5", "--json") == 1
    assert outcomes(capsys)["r4"]["text"] == "not done within 5 s"


@pytest.mark.parametrize(
    "words",
    [
        ("command", "touch done"),
        ("services", "restart", "dwm"),
        ("app", "stop", "consensus", "--real"),
        ("status",),
        ("fetch",),
        ("flash",),
        ("measure", "i2c"),
    ],
)
def test_a_robot_of_another_name_at_an_address_carries_out_no_command(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    home = robots.add("r0")
    robots.script("r0", "sed", 'case $2 in s/^SWARM_ROBOT*) echo r7 ;; *) exec /usr/bin/sed "$@" ;; esac')
    robots.script("r0", "sudo", "touch done")
    assert run(*words) == 1
    said = capsys.readouterr().out
    assert "the robot at r0 says that it is r7: correct `host` in swarm.toml, or swarm deploy --rename" in said
    assert not (home / "done").exists()


@pytest.mark.parametrize(
    "words", [("fetch",), ("pair",), ("measure", "i2c"), ("deploy", "release.tar.gz"), ("provision",)]
)
def test_a_robot_that_hangs_is_given_up_after_its_first_question(
    robots: FakeRobots,
    run: Run,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(robots.folder)
    monkeypatch.setattr(everyone, "ASK_S", 0.3)
    make_release(robots.folder / "release.tar.gz", "1-a", {})
    robots.add("r0", hook="echo $$ >> hung; exec sleep 1000")
    assert run(*words) == 1
    assert "within 0.3 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [("deploy", "release.tar.gz"), ("services", "stop"), ("services", "restart", "balancer"), ("provision",)]
)
def test_work_that_ends_the_balancer_of_a_standing_robot_is_refused_without_force(
    robots: FakeRobots,
    run: Run,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
) -> None:
    """r0 stands, and r1 tells no mode: its services are down."""
    monkeypatch.chdir(robots.folder)
    make_release(robots.folder / "release.tar.gz", "1-a", {})
    state = '{"key": "swarm/r0/balancer/state", "value": {"mode": "lying_down"}}'
    for name in ("r0", "r1"):
        add_python(robots.add(name))
        answer = f"echo '{state}'" * (name == "r0")
        text = f'shift; case "$*" in */z_sub*) [ "$2" != swarm/r0/balancer/state ] || {answer or "true"} ;;'
        robots.script(name, "sudo", f'{text} *) touch $HOME/done; exec "$@" ;; esac')
    run(*words, "--json")
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r0"]["text"]) == (
        False,
        "it is lying down, and would fall when its balancer ends: lay it down first "
        "(swarm balance lie --robots r0), or --force",
    )
    assert "would fall" not in str(found["r1"]["text"])
    assert not (robots.folder / "r0/done").exists()
    run(*words, "--json", "--force", "--robots", "r0")
    assert "would fall" not in str(outcomes(capsys)["r0"]["text"])
    assert (robots.folder / "r0/done").exists()


@pytest.mark.parametrize("words", [("logs", "r0"), ("logs", "mesh", "r0"), ("services", "restart", "dwm", "r0")])
def test_the_name_of_a_robot_where_another_name_is_wanted_says_where_it_belongs(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    home = robots.add("r0")
    robots.script("r0", "sudo", "touch done")
    assert run(*words) == 2
    assert re.search("r0 is a robot, and not a service.*: name robots by --robots r0\n", capsys.readouterr().err)
    assert not (home / "done").exists()


def test_a_run_that_is_not_here_is_no_service_of_the_robots(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(robots.folder)
    robots.add("r0")
    assert run("logs", "consensus-1234567890abcdef") == 2
    assert "no such run; swarm fetch brings those of the robots" in capsys.readouterr().err


@pytest.mark.parametrize("words", [("start",), ("restart", "dwm"), ("stop", "mesh")])
def test_services_that_leave_the_balancer_alone_ask_no_robot_whether_it_stands(
    robots: FakeRobots, run: Run, words: tuple[str, ...]
) -> None:
    robots.add("r0")
    robots.script("r0", "sudo", 'shift; case "$*" in */z_sub*) touch $HOME/asked ;; *) exec "$@" ;; esac')
    assert run("services", *words) == 0
    assert not (robots.folder / "r0/asked").exists()


@pytest.mark.parametrize(
    ("words", "code"),
    [(("command", "true"), 0), (("services", "stop", "balancer"), 0), (("logs",), 0), (("deploy",), 2)],
)
def test_a_robot_without_a_bluetooth_address_is_reached_all_the_same(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], code: int
) -> None:
    """A new robot is written into the file before `swarm pair` finds its address; only robots need that."""
    for name in ("r0", "r1"):
        robots.add(name)
        robots.script(name, "journalctl", "echo line")
    text = robots.config.read_text()
    robots.config.write_text(re.sub(r"^link = .*\n", "", text, flags=re.MULTILINE))
    assert run(*words) == code
    assert ("(swarm pair writes it)" in capsys.readouterr().err) == bool(code)


HANGS = """case "$SSH_ORIGINAL_COMMAND" in *uname*|*release*) echo $$ >>hung; exec sleep 1000 ;; esac; exit 3"""
"""Hangs at the question that comes first, and fails at what follows."""


@pytest.mark.parametrize("words", [("deploy",), ("run", "consensus")])
def test_a_robot_that_hangs_at_the_first_question_holds_up_the_others_for_a_while_only(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.setattr(everyone, "ASK_S", 0.3)
    robots.add("r0", hook=HANGS)
    ended: list[float] = []
    each = everyone.each

    async def timed(*arguments: Any) -> list[everyone.RobotOutcome]:
        ended.append(arguments[2])
        return [] if len(ended) > 1 else await each(*arguments)

    monkeypatch.setattr(everyone, "each", timed)
    run(*words, "--timeout", "5")
    assert ended == [0.3, 5.0]


def test_services_are_started_by_their_names(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    home = robots.add("r0")
    assert run("services", "restart", "mesh", "consensus") == 0
    assert run("services", "start") == 0
    assert run("services", "stop", "dwm") == 0
    assert (home / "systemctl.log").read_text().splitlines() == [
        "restart swarm-mesh.service",
        "restart --no-block swarm-app@consensus.service",
        "start swarm.target",
        "stop swarm-dwm.service",
    ]
    assert run("services", "stop", "No Such") == 2
    assert "'No Such': expected bus, mesh, balancer, dwm or the name of an app" in capsys.readouterr().err
