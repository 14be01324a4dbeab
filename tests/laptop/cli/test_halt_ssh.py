"""`swarm estop` and `swarm arm` by ssh: robots that confirm, robots that do not, and robots that cannot be reached."""

import argparse
import json
import os
import re
import socket
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from conftest import wait_until
from fake_robots import FakeRobots, Run
from needs import needs_ssh

from laptop import cli
from laptop.cli import halt as halt_ssh
from laptop.fleet.ssh.ssh import Host
from swarm import clock
from swarm.config import load
from swarm.errors import ConfigError, LocalError
from swarm.onboard import command_line
from swarm.onboard.buses import buses
from swarm.onboard.halt import Row

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh


@pytest.fixture(autouse=True)
def _laptop(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("SWARM_RUNTIME", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # where no simulation runs
    monkeypatch.setattr(halt_ssh, "DEFAULT_RUNTIME", tmp_path / "no-robot")


def answer(*confirmed: str, silent: tuple[str, ...] = ()) -> str:
    rows: list[dict[str, object]] = [{"robot": name, "confirmed": True, "mode": "fault"} for name in confirmed]
    rows += [{"robot": name, "confirmed": False} for name in silent]
    return json.dumps({"stop": True, "confirmed": not silent, "robots": rows})


def add(robots: FakeRobots, name: str, said: str, code: int = 0) -> Path:
    home = robots.add(name)
    text = (
        f"case $2 in env) shift; printf '%s\\n' \"$*\" > asked; echo '{said}'; exit {code} ;; *) shift; \"$@\" ;; esac"
    )
    robots.script(name, "sudo", text)
    return home


def test_every_robot_is_told_on_its_own_bus(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    homes = [add(robots, name, answer(name)) for name in ("r0", "r1")]
    assert run("estop", "it's burning") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["r0", "yes", "ssh", "its", "own", "bus", "and", "balancer", "say", "so"]
    assert lines[-1] == "stopped: 2 of 2 robots"
    asked = (homes[1] / "asked").read_text().replace(str(robots.folder), "")
    words = "/opt/swarm/current/bin/swarm estop it's burning --json --timeout 3.0\n"
    assert asked == f"env SWARM_ROBOT=r1 SWARM_RUNTIME=/run/swarm {words}"
    assert not (homes[0] / "systemctl.log").exists()
    assert run("arm") == 0
    assert "/bin/swarm arm --json" in (homes[0] / "asked").read_text()


def test_a_robot_that_does_not_confirm_has_its_balancer_stopped(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    quiet = add(robots, "r0", answer(silent=("r0",)), 1)
    broken = add(robots, "r1", "no swarm here", 127)
    assert run("estop", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["confirmed"] is True
    assert found["ssh"]["r0"]["text"].startswith("its balancer was stopped (its bus does not confirm it)")
    assert all((home / "systemctl.log").read_text() == "stop swarm-balancer.service\n" for home in (quiet, broken))
    # Nothing of that for taking a stop back.
    assert run("arm") == 1
    assert (quiet / "systemctl.log").read_text().count("\n") == 1


def test_an_answer_that_is_neither_yes_nor_no_confirms_no_stop(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [{"robot": name, "confirmed": "no", "mode": "balancing"} for name in ("r0", "r1")]
    home = add(robots, "r0", json.dumps({"robots": rows}))
    robots.add("r1", up=False)
    assert run("estop") == 1
    assert capsys.readouterr().out.splitlines()[-1] == "stopped: 1 of 2 robots; NOT CONFIRMED: r1"
    assert (home / "systemctl.log").read_text() == "stop swarm-balancer.service\n"


def test_another_robot_at_its_address_confirms_no_stop(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    home = add(robots, "r0", answer(silent=("r0",)), 1)
    robots.script("r0", "sed", "echo r7")
    assert run("estop") == 1
    out = capsys.readouterr().out
    assert "its balancer was stopped, but it says that it is r7: correct `host`" in out
    assert out.splitlines()[-1] == "stopped: 0 of 1 robots; NOT CONFIRMED: r0"
    assert (home / "systemctl.log").read_text() == "stop swarm-balancer.service\n"


@pytest.mark.parametrize("mode", [None, "missing"])
def test_a_robot_whose_balancer_is_not_heard_has_it_stopped(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], mode: str | None
) -> None:
    """Its mesh has obeyed, but the balancer's bridge may be dead, while the loop balances on."""
    row: dict[str, object] = {"robot": "r0", "confirmed": True} | ({} if mode == "missing" else {"mode": mode})
    home = add(robots, "r0", json.dumps({"robots": [row]}))
    assert run("estop") == 0
    assert "its balancer was stopped (its balancer tells no state)" in capsys.readouterr().out
    assert (home / "systemctl.log").read_text() == "stop swarm-balancer.service\n"


def test_a_robot_whose_command_hangs_has_its_balancer_stopped(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(halt_ssh, "_HANGS_S", 1.0)
    home = robots.add("r0")
    robots.script("r0", "sudo", 'case $2 in env) echo $$ >hung; exec sleep 600 ;; *) shift; "$@" ;; esac')
    assert run("estop") == 0
    assert "its balancer was stopped (its own command has not ended within 1 s)" in capsys.readouterr().out
    assert (home / "systemctl.log").read_text() == "stop swarm-balancer.service\n"


def test_a_bus_that_does_not_answer_here_keeps_no_robot_from_its_stop(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of a simulation that is just starting or ending on the laptop."""
    home = add(robots, "r0", answer("r0"))

    def refuse(*_: object, **__: object) -> None:
        raise LocalError("no bus is there")

    monkeypatch.setattr(halt_ssh, "_simulated", lambda _: {"r0": home})
    monkeypatch.setattr(halt_ssh.halt, "stop_or_arm", refuse)
    assert run("estop") == 0
    shown = capsys.readouterr()
    assert shown.out.splitlines()[-1] == "stopped: 1 of 1 robots"
    assert "no bus is there" in shown.err


def test_a_stop_that_reaches_no_robot_at_all_is_not_confirmed(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots.add("r0")
    monkeypatch.setattr(halt_ssh, "_simulated", lambda _: {"s0": Path("/nowhere")})
    lost = [Row("s0", "no bus", None, None, False)]  # its bus has ended meanwhile
    monkeypatch.setattr(halt_ssh.halt, "stop_or_arm", lambda *_, **__: lost)
    assert run("estop", "--robots", "s0") == 1
    assert run("estop", "--robots", "s0", "--no-ssh") in (1, 2)


@pytest.fixture
def simulation(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A simulation runs on the laptop with robots r0, r1 and s0, which obey; the names of those that were told."""
    told: list[str] = []

    def give(found: dict[str, Path], *, stop: bool, **_: object) -> list[Row]:
        told.extend(found)
        return [Row(name, "here", stop, "fault", True) for name in found]

    def find(args: argparse.Namespace) -> dict[str, Path]:
        return buses.only_wanted(dict.fromkeys(("r0", "r1", "s0"), Path("/nowhere")), args.robots or ())

    monkeypatch.setattr(halt_ssh.halt, "stop_or_arm", give)
    monkeypatch.setattr(halt_ssh.halt.buses, "directories_of", find)
    monkeypatch.setattr(halt_ssh, "_simulated", lambda _: dict.fromkeys(("r0", "r1", "s0"), Path("/nowhere")))
    return told


def test_a_simulated_robot_confirms_nothing_for_a_real_one_of_its_name(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], simulation: list[str]
) -> None:
    add(robots, "r0", answer("r0"))
    robots.add("r1", up=False)
    assert run("estop") == 1
    lines = capsys.readouterr().out.splitlines()
    assert simulation == ["r0", "r1", "s0"]
    assert lines[0] == "simulated robots"
    assert "stopped: 3 of 3 robots" in lines[: lines.index("real robots")]
    assert lines[-1] == "stopped: 1 of 2 robots; NOT CONFIRMED: r1"


@pytest.mark.parametrize(
    ("names", "real", "simulated"), [("r1", ["r1"], ["r1"]), ("s0", [], ["s0"]), ("r0,s0", ["r0"], ["r0", "s0"])]
)
def test_robots_that_are_named_are_told_real_and_simulated(
    robots: FakeRobots, run: Run, simulation: list[str], names: str, real: list[str], simulated: list[str]
) -> None:
    homes = {name: add(robots, name, answer(name)) for name in ("r0", "r1")}
    assert run("estop", "--robots", names) == 0
    assert [name for name, home in homes.items() if (home / "asked").exists()] == real
    assert simulation == simulated


def test_a_stop_that_names_a_simulation_and_a_config_reaches_the_robots_of_both(
    robots: FakeRobots, run: Run, simulation: list[str]
) -> None:
    home = add(robots, "r0", answer("r0"))
    assert run("estop", "--run-dir", str(robots.folder)) == 0
    assert (home / "asked").exists()
    assert "s0" in simulation


@pytest.mark.parametrize("way", [(), ("--no-ssh",)])
def test_a_name_that_nobody_knows_keeps_no_other_robot_from_its_stop_and_is_told(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], simulation: list[str], way: tuple[str, ...]
) -> None:
    home = add(robots, "r0", answer("r0"))
    assert run("estop", "--robots", "r7,r0", "--json", *way) == 1
    shown = capsys.readouterr()
    assert "there is no robot r7: NOBODY WAS STOPPED BY THAT NAME" in shown.err
    found = json.loads(shown.out)
    assert (found["confirmed"], found["unknown"]) == (False, ["r7"])
    assert simulation == ["r0"]
    assert (home / "asked").exists() is (way == ())


@pytest.mark.parametrize(("act", "names"), [("estop", "r7,r8"), ("arm", "r0,r7,r8")])
def test_a_stop_of_unknown_robots_alone_and_a_rearm_of_any_are_refused(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], simulation: list[str], act: str, names: str
) -> None:
    home = add(robots, "r0", answer("r0"))
    assert run(act, "--robots", names) == 2
    assert "there is no robot r7, r8, but r0, r1, s0; NO ROBOT WAS STOPPED OR ARMED" in capsys.readouterr().err
    assert not simulation
    assert not (home / "asked").exists()


def test_a_configuration_that_is_damaged_keeps_no_simulation_from_its_stop_and_is_told(
    robots: FakeRobots,
    run: Run,
    capsys: pytest.CaptureFixture[str],
    simulation: list[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "here/swarm.toml").write_text("network = 3")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.delenv("SWARM_CONFIG", raising=False)
    with pytest.raises(SystemExit) as end:
        cli.main(["estop"])
    assert end.value.code == 1
    shown = capsys.readouterr()
    assert simulation == ["r0", "r1", "s0"]
    assert "stopped: 3 of 3 robots" in shown.out
    assert "no real robot was told" in shown.err


def test_a_rearm_says_when_it_was_given_so_that_it_takes_back_no_later_stop(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = add(robots, "r0", answer("r0"))
    given = clock.now()
    assert run("arm") == 0
    words = (home / "asked").read_text().split()
    with Path("/proc/uptime").open() as file:
        there = float(file.read().split()[0]) - clock.now()
    assert given - 0.1 <= float(words[words.index("--since") + 1]) - there <= clock.now()


def test_a_rearm_of_a_laptop_that_slept_meanwhile_takes_back_no_stop_of_that_time(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It sleeps for 600 s once the command is given."""
    home = add(robots, "r0", answer("r0"))
    elapsed = halt_ssh.elapsed
    monkeypatch.setattr(halt_ssh, "elapsed", lambda: elapsed() + (600.0 if (home / "slept").exists() else 0.0))
    robots.script("r0", "cat", "touch slept; exec /bin/cat $*")
    assert run("arm") == 0
    words = (home / "asked").read_text().split()
    with Path("/proc/uptime").open() as file:
        now = float(file.read().split()[0])
    assert float(words[words.index("--since") + 1]) <= now - 600.0


def test_the_clock_of_a_rearm_is_one_that_every_system_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("swarm.clock.time.CLOCK_BOOTTIME")
    before = clock.now()
    assert before <= clock.elapsed() <= clock.now()


def test_a_robot_with_an_earlier_release_is_not_armed_and_the_mend_is_named(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the time of the command it would take back stops that came later."""
    robots.add("r0")
    refusal = "echo 'swarm arm: error: unrecognized arguments: --since 1' >&2; exit 2"
    text = f"""case "$*" in *--since*) {refusal} ;; *) echo '{answer("r0")}' ;; esac"""
    robots.script("r0", "sudo", text)
    assert run("arm") == 1
    assert "its release is older than this program: swarm deploy" in capsys.readouterr().out


def test_a_simulation_is_stopped_where_the_robots_of_swarm_toml_are_not_paired_yet(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], simulation: list[str]
) -> None:
    homes = [add(robots, name, answer(name)) for name in ("r0", "r1")]
    robots.ready()
    bluetooth = [line for line in robots.config.read_text().splitlines() if not line.startswith("link")]
    robots.config.write_text("\n".join(bluetooth))
    with pytest.raises(ConfigError, match="bluetooth"):
        load(robots.config)
    assert run("estop") == 0
    assert simulation == ["r0", "r1", "s0"]
    assert all((home / "asked").exists() for home in homes)


def test_a_connection_that_breaks_is_made_once_more_for_a_stop(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    home = robots.add("r0")
    # The first command ends its connection: sshd's process for it is the shell's parent.
    robots.script("r0", "sudo", 'case $2 in env) kill -9 $PPID; sleep 5 ;; *) shift; "$@" ;; esac')
    assert run("estop") == 0
    assert (home / "systemctl.log").read_text() == "stop swarm-balancer.service\n"
    assert (
        "its balancer was stopped (ssh, or the command, ended with code 255 without a word)" in capsys.readouterr().out
    )


def test_a_stop_waits_for_no_connection_that_ssh_shares(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the user's own session keeps one, and the laptop was in another network meanwhile."""
    monkeypatch.setattr(halt_ssh, "_HANGS_S", 60.0)
    add(robots, "r0", answer("r0"))
    place = robots.folder / "dead"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(place))
        dead.listen()
        robots.ssh_config.write_text(f"ControlPath {place}\n{robots.ssh_config.read_text()}")
        assert run("estop") == 0


def test_robots_of_which_ssh_tells_nothing_are_not_confirmed(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    robots.add("r0")
    monkeypatch.setattr(halt_ssh, "command", lambda *_, **__: halt_ssh._Answers())
    assert run("estop") == 1
    assert "NOT CONFIRMED: r0" in capsys.readouterr().out


def test_one_that_cannot_be_reached_is_confirmed_by_what_others_see(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    add(robots, "r0", answer("r0", "r1"))
    robots.add("r1", up=False)
    robots.add("r2", up=False)
    assert run("estop") == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split("  ")[0] == "r1"
    assert "mesh (seen by r0)" in lines[2]
    assert "NOT CONFIRMED" in lines[3]
    assert "it runs no ssh server" in lines[3]
    assert lines[-1] == "stopped: 2 of 3 robots; NOT CONFIRMED: r2"


def test_without_any_path_it_says_so(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    robots.add("r0")
    assert run("estop", "--no-ssh") == 2
    assert re.search("no simulation is running.*; NO ROBOT WAS STOPPED OR ARMED\n", capsys.readouterr().err)
    robots.ready()
    monkeypatch.setenv("PATH", "/nowhere")
    assert run("estop") == 1
    assert "there is no ssh here" in capsys.readouterr().out
    robots.config.write_text("network = 3")
    assert run("estop") == 2
    assert re.search("swarm.toml.*; NO ROBOT WAS STOPPED OR ARMED\n", capsys.readouterr().err)


@pytest.mark.parametrize("wrong", ["[body]\nbogus = 3\n", "[mesh\n", "link = \n", '[[robots]]\nname = "R1"\n'])
def test_a_stop_reaches_the_robots_that_a_wrong_configuration_names(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], wrong: str
) -> None:
    homes = [add(robots, name, answer(name)) for name in ("r0", "r1")]
    robots.ready()
    robots.config.write_text(robots.config.read_text().replace("[mesh]", f"{wrong}[mesh]"))
    assert run("estop", "--json") == 1
    shown = capsys.readouterr()
    assert re.search("swarm.toml: .*; NOBODY KNOWS WHETHER MORE ROBOTS THAN THESE ARE MEANT", shown.err)
    found = json.loads(shown.out)
    assert (found["confirmed"], sorted(found["ssh"])) == (False, ["r0", "r1"])
    for home in homes:
        (home / "asked").unlink()
    assert run("arm") == 2
    assert "NO ROBOT WAS STOPPED OR ARMED" in capsys.readouterr().err
    assert not any((home / "asked").exists() for home in homes)


def test_a_stop_whose_configuration_is_missing_where_the_variable_says_names_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SWARM_CONFIG", str(tmp_path / "none.toml"))
    with pytest.raises(SystemExit) as end:
        cli.main(["estop"])
    assert end.value.code == 2
    wanted = (
        "none.toml: there is no such file, which the variable SWARM_CONFIG names; .*; NO ROBOT WAS STOPPED OR ARMED"
    )
    assert re.search(wanted, capsys.readouterr().err)


def test_an_interrupted_stop_says_so(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    add(robots, "r0", answer("r0"))
    monkeypatch.setattr(halt_ssh, "_simulated", lambda _: {"s0": Path("/nowhere")})
    monkeypatch.setattr(halt_ssh.halt, "stop_or_arm", MagicMock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr(command_line, "leave", sys.exit)  # not at once, as with a connection that is still there
    assert run("estop") == 130
    for thread in threading.enumerate():
        if thread.name == "ssh":
            thread.join()
    assert "INTERRUPTED; 0 of 1 real robots have confirmed until now; OTHERS MAY NOT" in capsys.readouterr().err


def test_a_note_that_cannot_be_written_keeps_no_robot_from_its_stop(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with `2>log` on a full disk. Without its own command confirming, the robot's balancer is stopped."""
    monkeypatch.setattr(halt_ssh, "_NOTE_S", 0.0)
    home = add(robots, "r0", answer(silent=("r0",)), 1)
    monkeypatch.setattr(sys, "stderr", MagicMock(write=MagicMock(side_effect=OSError(28, "No space left on device"))))
    monkeypatch.setattr(command_line, "guard", lambda: None)
    assert run("estop") == 0
    assert (home / "systemctl.log").read_text() == "stop swarm-balancer.service\n"


def test_while_a_robot_does_not_answer_those_that_have_confirmed_are_named(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The slow robot answers when the note is written."""
    monkeypatch.setattr(halt_ssh, "_NOTE_S", 0.0)
    add(robots, "r0", answer("r0"))
    add(robots, "r1", answer("r1"))
    robots.script("r1", "sudo", f"cat go; echo '{answer('r1')}'")
    os.mkfifo(robots.folder / "r1/go")
    tell = halt_ssh._so_far

    def told(real: Sequence[Host], confirmed: Sequence[str]) -> str:
        wait_until(lambda: "r0" in confirmed, what="r0 confirms")
        (robots.folder / "r1/go").write_text("")
        return tell(real, confirmed)

    monkeypatch.setattr(halt_ssh, "_so_far", told)
    assert run("estop") == 0
    assert "swarm: 1 of 2 real robots have confirmed until now (r0); waiting" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('[[robots]]\nname = "r0"\nhost="pi@10.0.0.7" # here\n', {"r0": "pi@10.0.0.7"}),
        ("[[ robots ]] # the first\n  name = 'r0'\n[topology]\nname = \"r9\"", {"r0": "r0"}),
        ('[[robots]\nname = "r0"\n[[robots]]\nname = "r1"', {"r0": "r0", "r1": "r1"}),
        ('[[robots]]\nname = "r0"\nhost = "-oProxyCommand=id"\n[[robots]]\nname = ""\n', {}),
        ('# [[robots]]\n# name = "r0"\n[robot]\nname = "r1"', {}),
    ],
)
def test_robots_that_can_be_read_in_a_wrong_configuration(tmp_path: Path, text: str, found: dict[str, str]) -> None:
    path = tmp_path / "swarm.toml"
    path.write_text(text)
    assert {name: host.address for name, host in halt_ssh.legible(path).items()} == found


def test_no_robot_can_be_read_where_there_is_no_file(tmp_path: Path) -> None:
    assert halt_ssh.legible(tmp_path) == halt_ssh.legible(tmp_path / "none") == halt_ssh.legible(None) == {}


@pytest.mark.parametrize("words", [["--timeut", "2"], ["fell", "--off", "2"], ["--timeout", "soon"]])
def test_a_mistyped_stop_says_that_no_robot_was_stopped(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["estop", *words])
    assert ended.value.code == 2
    assert "NO ROBOT WAS STOPPED OR ARMED: swarm estop, without more, stops all" in capsys.readouterr().err
