"""Finding a running simulation, and `swarm hand kill` and `swarm hand cut`."""

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
from pathlib import Path

import msgpack
import pytest
from conftest import Processes, wait_until

from laptop.cli import hand
from swarm.errors import BusError, LocalError
from swarm.process.simulations import claim, default_run_dir, is_live, pid_file, pid_of, robots

CLAIM = """
import sys
from pathlib import Path
from swarm.process.simulations import claim
with claim(Path(sys.argv[1])):
    print("claimed", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def run(processes: Processes, runtime: Path) -> Path:
    """A run directory that another process holds, with one robot."""
    directory = runtime / "run"
    process = processes.start("-c", CLAIM, str(directory))
    assert process.stdout is not None
    assert process.stdout.readline() == "claimed\n"
    (directory / "r0").mkdir()
    (directory / "swarm.toml").write_text('[[robots]]\nname = "r0"\n[[robots]]\nname = "r1"\n')
    return directory


def test_the_environment_names_the_default_run_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert default_run_dir() == Path("/run/user/7/swarm-sim")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert default_run_dir() == Path(f"/tmp/swarm-sim-{os.getuid()}")


def test_a_claim_lives_as_long_as_its_holder(runtime: Path) -> None:
    directory = runtime / "a" / "run"
    assert not is_live(directory)
    with claim(directory):
        assert is_live(directory)
        assert directory.stat().st_mode & 0o077 == 0
        with pytest.raises(BusError, match=rf"already running there \(pid {os.getpid()}\); end it or use --run-dir"):
            claim(directory)
    assert not is_live(directory)
    with claim(directory):
        assert is_live(directory)


def test_a_killed_holder_leaves_the_directory_free(processes: Processes, runtime: Path) -> None:
    holder = processes.start("-c", CLAIM, str(runtime / "run"))
    assert holder.stdout is not None
    holder.stdout.readline()
    assert is_live(runtime / "run")
    holder.kill()
    holder.wait()
    assert not is_live(runtime / "run")
    claim(runtime / "run").close()


def test_looking_does_not_get_in_the_way_of_a_claim(processes: Processes, runtime: Path) -> None:
    claim(runtime / "run").close()
    code = """
import sys
from pathlib import Path
from swarm.process.simulations import is_live
print("looking", flush=True)
while True:
    is_live(Path(sys.argv[1]))
"""
    looking = processes.start("-c", code, str(runtime / "run"))
    assert looking.stdout is not None
    looking.stdout.readline()
    for _ in range(20):
        claim(runtime / "run").close()


def test_a_directory_with_other_things_is_not_taken(runtime: Path) -> None:
    """A simulation clears its directory: `--run-dir ~` must not."""
    (runtime / "thesis.tex").write_text("years of work")
    with pytest.raises(BusError, match="neither empty nor a run directory"):
        claim(runtime)
    with pytest.raises(BusError, match=r"no run directory: (File exists|Not a directory)"):
        claim(runtime / "thesis.tex")
    with pytest.raises(BusError, match="no run directory"):
        claim(Path("/proc/run"))


def test_the_robots_of_a_simulation_are_the_folders_with_a_bus(run: Path) -> None:
    assert robots(run) == {"r0": run / "r0", "r1": run / "r1"}
    (run / "r7").mkdir()
    (run / "r7" / "bus.sock").touch()
    (run / "records").mkdir()
    assert list(robots(run)) == ["r0", "r1", "r7"]
    for text in ("[[robots", "robots = 3", "[[robots]]\nboard = 'x'", "[[robots]]\nname = '../..'", "\xff"):
        (run / "swarm.toml").write_text(text, encoding="latin-1")
        assert list(robots(run)) == ["r7"]
    assert robots(run / "missing") == {}


@pytest.mark.parametrize("text", ["", "x", "-5", "0", "1", "4.5", "\xff"])
def test_notes_that_are_no_pid(run: Path, text: str) -> None:
    pid_file(run, "r0", "mesh").write_text(text, encoding="latin-1")
    assert pid_of(run, "r0", "mesh") is None


def victim(processes: Processes, run: Path, service: str) -> subprocess.Popen[str]:
    """A process that is r0's `service` as far as `swarm hand kill` can tell."""
    process = processes.start("-c", "input()", SWARM_RUNTIME=str(run / "r0"))
    pid_file(run, "r0", service).write_text(f"{process.pid}\n")
    wait_until(lambda: b"SWARM_RUNTIME" in Path(f"/proc/{process.pid}/environ").read_bytes())
    return process


def hands(run: Path, *arguments: str) -> int:
    parser = argparse.ArgumentParser()
    hand.add_arguments(parser)
    return hand.run(parser.parse_args([*arguments, "--run-dir", str(run)]))


def call(run: Path, *arguments: str) -> int:
    return hands(run, "kill", *arguments)


@pytest.mark.parametrize("service", ["bus", "mesh", "app/consensus"])
def test_the_command_kills_a_service_of_a_simulated_robot(
    processes: Processes, run: Path, service: str, capsys: pytest.CaptureFixture[str]
) -> None:
    process = victim(processes, run, service)
    assert call(run, "r0", service) == 0
    assert process.wait(60) == -signal.SIGKILL
    assert capsys.readouterr().out == f"r0: {service} (pid {process.pid}): SIGKILL\n"
    with pytest.raises(LocalError, match=f"{service} of r0 is not running at this moment"):
        call(run, "r0", service)


def state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_kill_freezes_a_service_and_lets_it_continue(processes: Processes, run: Path) -> None:
    process = victim(processes, run, "app/consensus")
    call(run, "r0", "app", "--signal", "STOP")
    wait_until(lambda: state(process.pid) == "T")
    call(run, "r0", "app", "--signal", "CONT")
    wait_until(lambda: state(process.pid) != "T")
    call(run, "r0", "app", "--signal", "TERM")
    assert process.wait(60) == -signal.SIGTERM


def test_a_pid_that_belongs_to_somebody_else_by_now_is_spared(processes: Processes, run: Path) -> None:
    process = processes.start("-c", "input()", SWARM_RUNTIME=str(run / "r1"))
    wait_until(lambda: b"SWARM_RUNTIME" in Path(f"/proc/{process.pid}/environ").read_bytes())
    pid_file(run, "r0", "mesh").write_text(f"{process.pid}\n")
    with pytest.raises(LocalError, match="mesh of r0 is not running"):
        call(run, "r0", "mesh")
    assert process.poll() is None


def test_kill_refuses_unknown_robots_and_services(run: Path, runtime: Path) -> None:
    for arguments, wanted in (
        (("r9", "mesh"), "no robot 'r9' in the simulation, there are r0, r1"),
        (("r0", "radio"), "no service 'radio'; there are bus, mesh, balancer, dwm"),
        (("r0", "app/../../x"), "no service"),
        (("r0", "app"), "r0 runs no app"),
        (("r1", "mesh"), "mesh of r1 is not running"),
    ):
        with pytest.raises(LocalError, match=wanted):
            call(run, *arguments)
    with pytest.raises(LocalError, match="no simulation is running in"):
        call(runtime, "r0", "mesh")
    pid_file(run, "r0", "app/a").touch()
    pid_file(run, "r0", "app/b").touch()
    with pytest.raises(LocalError, match="expected app/NAME: r0 runs app/a, app/b"):
        call(run, "r0", "app")


@pytest.mark.parametrize(("option", "seconds"), [(("--seconds", "3"), 3.0), (("--mend",), 0.0)])
def test_a_cut_reaches_both_ends_of_a_link(
    run: Path, option: tuple[str, ...], seconds: float, capsys: pytest.CaptureFixture[str]
) -> None:
    with contextlib.ExitStack() as stack:
        meshes = {}
        for name in ("r0", "r1"):
            (run / name).mkdir(exist_ok=True)
            meshes[name] = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            meshes[name].bind(str(run / name / "air.sock"))
            meshes[name].settimeout(60)
        assert hands(run, "cut", "r0", "r1", *option, "--json") == 0
        told = {name: msgpack.unpackb(mesh.recv(1000)) for name, mesh in meshes.items()}
    assert told == {"r0": {"cut": "r1", "seconds": seconds}, "r1": {"cut": "r0", "seconds": seconds}}
    assert json.loads(capsys.readouterr().out)["act"] == "cut"


def test_a_robot_is_not_cut_from_itself(run: Path) -> None:
    with pytest.raises(LocalError, match="not cut: r0 has no link with itself"):
        hands(run, "cut", "r0", "r0")


def test_a_cut_of_a_robot_that_is_not_there_is_an_error(run: Path) -> None:
    with pytest.raises(LocalError, match="not cut: there is no robot r1"):
        hands(run, "cut", "r0", "r1")
