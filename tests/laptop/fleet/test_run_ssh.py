"""`swarm run` over real ssh servers: an app is started on all robots, or on none."""

import re

import pytest
from fake_releases import add_robot, files
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh


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


def test_only_the_first_of_several_apps_decides_when_the_run_ends(robots: FakeRobots, run: Run) -> None:
    home = add_robot(robots, "r0")
    assert run("run", "consensus", "led_sync", "--until", "converged", "--absent", "drop", "--no-record") == 0
    first, beside = (files(home / "etc")[f"apps/{name}.env"] for name in ("consensus", "led_sync"))
    assert " --until converged --rounds 10 " in first
    assert "--until" not in beside  # it has no common iteration, and would not start
    assert " --absent drop " in first
    assert " --absent drop " in beside


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
    assert re.fullmatch(r"swarm-app@consensus\.service runs: consensus-[0-9a-f]{16}", str(found["r0"]["text"]))
    assert found["r1"]["text"] == (
        "swarm-app@consensus.service has failed: first | ModuleNotFoundError: No module named numpy"
    )


@pytest.mark.parametrize("words", [("services", "start"), ("services", "restart"), ("app", "start")])
def test_an_app_that_waits_when_it_is_started_is_reported_at_once(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    """systemctl itself would return when the app has its first measurement, which may take hours."""
    homes = [add_robot(robots, name) for name in ("r0", "r1", "r2")]
    (homes[0] / "state").write_text("activating\n")
    (homes[0] / "status").write_text("starting the dwm service gives no measurement\n")
    (homes[2] / "state").write_text("failed\n")
    for home in homes:
        waits = f"touch {home}/blocked; sleep 60"
        blocks = f'case "$*" in *--no-block*|show*|stop*|"start swarm-mesh"*) ;; *) {waits} ;; esac\n'
        path = home / "bin/systemctl"
        path.write_text(path.read_text().replace("#!/bin/sh\n", f"#!/bin/sh\n{blocks}"))
    assert run(words[0], *words[1:], "localization", "--robots", "r0,r1,r2", "--json", "--timeout", "50") == 1
    assert not [home for home in homes if (home / "blocked").exists()]
    found, unit = outcomes(capsys), "swarm-app@localization.service"
    assert found["r0"]["text"] == (f"{words[1]} {unit}, which runs and waits: the dwm service gives no measurement")
    assert found["r1"]["text"] == f"{words[1]} {unit}"
    assert str(found["r2"]["text"]).startswith(f"{unit} has failed: ")
    assert [outcome["ok"] for outcome in found.values()] == [True, True, False]


def test_a_stop_of_what_was_never_there_is_told(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """systemd stops an app of any name without a word, as one that is spelled wrong, or a service that is."""
    home = add_robot(robots, "r0")
    (home / "state").write_text("inactive\n")
    (home / "etc/apps/consensus.env").touch()
    assert run("services", "stop", "mesh", "balanser", "consensus", "--json") == 1
    assert outcomes(capsys)["r0"]["text"] == "swarm-app@balanser.service does not run, and was never started on it"
    assert (home / "systemctl.log").read_text().startswith("stop swarm-mesh.service")
    assert run("app", "stop", "consensus") == 0
    (home / "state").write_text("activating\n")
    assert run("app", "stop", "balanser") == 0


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


def test_an_app_whose_files_came_in_part_is_sent_again(robots: FakeRobots, run: Run) -> None:
    """The connection breaks exactly behind the first file: that is a tar, too."""
    home = add_robot(robots, "r0")
    app = robots.folder / "mine.py"
    app.write_text("import other\nclass Mine: ...\n")
    (robots.folder / "other.py").write_text("x = 1\n")
    robots.script("r0", "head", "[ $2 -gt 2000 ] || exec /usr/bin/head $@; /usr/bin/head -c 1024; cat >/dev/null")
    assert run("run", str(app)) == 1
    (home / "bin/head").unlink()
    assert run("run", str(app)) == 0
    assert sorted(name.rpartition("/")[2] for name in files(home / "lib")) == ["mine.py", "other.py"]


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ({"release": "1-b"}, "different releases (r0 1-a, r1 1-b): swarm deploy the same"),
        pytest.param(
            {"revision": 2},
            "different firmware (r0 revision 1 (layout 1), r1 revision 2 (layout 1)): swarm flash",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"own": "r4"}, "other names than in swarm.toml (r1 r4): mend `host` there", marks=pytest.mark.slow
        ),
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
        (["consensus", "--iterations", "-1"], "expected 1 or more"),
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
