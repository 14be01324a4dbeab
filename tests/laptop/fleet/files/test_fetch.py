"""`swarm fetch` from real ssh servers: what breaks goes on where it was, and nothing is lost on either side."""

import json
import os
from pathlib import Path

import pytest
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

from laptop.fleet.core import collect
from swarm.process.locks import folder_lock

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh

DIES = """[ -e "$HOME/well" ] || { /usr/bin/head -c 1000000; kill -9 $SESSION; exit; }
exec /usr/bin/head "$@"
"""
"""In place of `head`: a robot that is switched off after a megabyte."""

JOURNAL = """case "$*" in *--after-cursor=*) from=${6#*i=} ;; *) from=0 ;; esac
for n in 1 2 3 4 5; do
    [ $n -le $from ] || [ $n -gt $(cat $HOME/entries) ] ||
        { printf '{"__CURSOR":"s=a;i=%s","__REALTIME_TIMESTAMP":"%s000000","MESSAGE":"entry %s",' $n $n $n &&
        echo '"_SYSTEMD_UNIT":"swarm-bus.service"}'; }
done"""


@pytest.fixture(autouse=True)
def _folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "RUNS", "runs")  # below the home folder of each robot


def add(robots: FakeRobots, name: str, files: dict[str, bytes], hook: str = "") -> Path:
    home = robots.add(name, hook=hook)
    for path, data in files.items():
        (home / "runs" / path).parent.mkdir(parents=True, exist_ok=True)
        (home / "runs" / path).write_bytes(data)
    (home / "entries").write_text("2")
    robots.script(name, "journalctl", JOURNAL)
    return home


def received(outcome: dict[str, object]) -> int:
    return int(str(outcome["text"]).partition(" bytes received")[0].rpartition(" ")[2])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_runs_of_all_robots_become_one_folder(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """What all robots have is there once; where one has something else under that name, both are."""
    for name in ("r0", "r1", "r2"):
        common = b"number 1" if name != "r2" else b"number 2"
        add(robots, name, {f"goto-1/{name}.goto.mcap": name.encode() * 9, "goto-1/run.toml": common})
    into = robots.folder / "here"
    assert run("fetch", "--into", str(into), "--robots", "r0,r1", "--json") == 0
    capsys.readouterr()
    assert run("fetch", "--into", str(into), "--robots", "r0,r1", "--json") == 0
    assert outcomes(capsys)["r0"]["text"] == "2 files of 1 runs, 0 bytes received, 0 new log entries"
    assert run("fetch", "--into", str(into), "--json") == 0
    assert received(outcomes(capsys)["r2"]) == 18 + 8
    found = contents(into / "goto-1")
    assert found == {
        "r0.goto.mcap": b"r0" * 9, "r1.goto.mcap": b"r1" * 9, "r2.goto.mcap": b"r2" * 9,
        "run.toml": b"number 1", "r2.run.toml": b"number 2",
    }  # fmt: skip
    assert (into / "journal/r1.log").read_text().splitlines() == [
        f"1970-01-01T00:00:0{n}.000000Z swarm-bus[-] info: entry {n}" for n in (1, 2)
    ]
    (robots.folder / "r2/entries").write_text("4")
    assert run("fetch", "--into", str(into), "--delete", "--json") == 0
    said = "2 files of 1 runs, 0 bytes received, 2 new log entries, 2 files deleted there"
    assert outcomes(capsys)["r2"]["text"] == said
    assert contents(into / "goto-1") == found


def test_a_run_that_no_robot_has_is_told(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    add(robots, "r0", {"goto-1/r0.goto.mcap": b"a"})
    add(robots, "r1", {})
    words = ["--into", str(robots.folder / "here"), "--no-logs"]
    assert run("fetch", "goto-1", *words) == 0
    assert run("fetch", "goto", *words) == 0
    assert capsys.readouterr().err == ""
    assert run("fetch", "goto-1", "goto-2", *words) == 1
    assert "called goto-2\n" in capsys.readouterr().err
    assert run("fetch", "r1", *words) == 1
    assert "called r1; r1 is a robot: --robots r1\n" in capsys.readouterr().err


def test_a_robot_that_dies_in_mid_transfer_goes_on_where_it_was(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    data = {"goto-1/r0.goto.mcap": os.urandom(3_000_000), "goto-1/r0.small": b"s"}
    home = add(robots, "r0", data, hook="SESSION=$PPID; export SESSION")
    robots.script("r0", "head", DIES)
    add(robots, "r1", {"goto-1/r1.goto.mcap": b"r1"})
    into = robots.folder / "here"
    assert run("fetch", "--into", str(into), "--delete", "--json") == 1
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r1"]["ok"]) == (False, True), found
    assert "in the middle of it" in str(found["r0"]["text"])
    assert contents(home / "runs") == data  # nothing is deleted there
    came = (into / "goto-1/r0.goto.mcap").stat().st_size
    assert 0 < came <= 1_000_000  # and nothing of what the kernel still held
    (home / "well").touch()
    assert run("fetch", "--into", str(into), "--delete", "--json") == 0
    assert received(outcomes(capsys)["r0"]) == 3_000_001 - came
    assert {f"goto-1/{path.name}": path.read_bytes() for path in (into / "goto-1").glob("r0.*")} == data
    assert contents(home / "runs") == {}
    assert not (home / "runs/goto-1").exists()


def test_what_grows_is_fetched_from_where_it_was(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    home = add(robots, "r0", {"goto-1/r0.goto.mcap": b"begin"})
    into = robots.folder / "here"
    assert run("fetch", "--into", str(into), "--json", "--no-logs") == 0
    with (home / "runs/goto-1/r0.goto.mcap").open("ab") as file:
        file.write(b", and more")
    capsys.readouterr()
    assert run("fetch", "--into", str(into), "--json", "--no-logs") == 0
    assert received(outcomes(capsys)["r0"]) == 10
    assert contents(into) == {"goto-1/r0.goto.mcap": b"begin, and more"}


@pytest.mark.parametrize("here", [b"other bytes", b"a longer file than that of the robot"])
def test_a_copy_that_is_another_file_is_kept_aside(robots: FakeRobots, run: Run, here: bytes) -> None:
    add(robots, "r0", {"goto-1/r0.goto.mcap": b"the robot's own bytes"})
    place = robots.folder / "here/goto-1/r0.goto.mcap"
    place.parent.mkdir(parents=True)
    place.write_bytes(here)
    assert run("fetch", "--into", str(robots.folder / "here"), "--no-logs") == 0
    assert place.read_bytes() == b"the robot's own bytes"
    assert place.with_name(f"{place.name}~1").read_bytes().startswith(here)


def test_only_what_has_a_verified_copy_is_deleted(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not a run that goes on, not one that was not asked for, not a strange name, not what changes meanwhile."""
    files = {"goto-1/r0.a": b"a", "goto-1/odd name": b"o", "leds-1/r0.a": b"l", "other-1/r0.a": b"x"}
    home = add(robots, "r0", files)
    (home / "units").write_text("swarm-app@leds.service loaded active running Balboa Swarm: the app leds\n")
    assert run("fetch", "goto", "leds", "--into", str(robots.folder / "here"), "--delete", "--no-logs", "--json") == 0
    assert "1 files deleted there, not of leds-1: it runs" in str(outcomes(capsys)["r0"]["text"])
    assert sorted(contents(home / "runs")) == ["goto-1/odd name", "leds-1/r0.a", "other-1/r0.a"]
    # It is written to between the copy and the deletion.
    robots.script("r0", "systemctl", "echo more >> $HOME/runs/other-1/r0.a")
    assert run("fetch", "other", "--into", str(robots.folder / "here"), "--delete", "--no-logs", "--json") == 1
    assert "the others have changed meanwhile" in str(outcomes(capsys)["r0"]["text"])
    assert (home / "runs/other-1/r0.a").read_bytes() == b"xmore\n"


def test_no_room_here_is_told_for_each_robot(robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    home = add(robots, "r0", {"goto-1/r0.a": b"a"})
    into = robots.folder / "here"
    into.mkdir()
    (into / "goto-1").write_text("a file where a folder should be")
    assert run("fetch", "--into", str(into), "--delete", "--json") == 1
    assert "cannot be kept here" in str(outcomes(capsys)["r0"]["text"])
    assert (home / "runs/goto-1/r0.a").exists()
    assert run("fetch", "--into", str(into / "goto-1" / "x")) == 2


def test_two_that_fetch_into_one_folder_at_the_same_time_do_not_mix_their_data(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    add(robots, "r0", {"goto-1/r0.a": b"a"})
    into = robots.folder / "here"
    into.mkdir()
    with folder_lock(into):
        assert run("fetch", "--into", str(into)) == 2
    assert "here: another swarm fetch writes to it: let it end, or choose another --into" in capsys.readouterr().err
    assert run("fetch", "--into", str(into), "--no-logs") == 0
    assert run("fetch", "--into", str(into / "goto-1/r0.a")) == 2
    assert "r0.a: it is no folder" in capsys.readouterr().err


@pytest.mark.parametrize("command", [("fetch",), ("logs",)])
def test_a_robot_whose_journal_has_no_entry_of_ours_yet_is_no_failure(
    robots: FakeRobots, run: Run, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    """journalctl fails where it is given a pattern alone and no unit matches."""
    monkeypatch.chdir(robots.folder)
    add(robots, "r0", {"goto-1/r0.goto.mcap": b"r0"})
    no_data = "echo 'Failed to add filter for units: No data available' >&2; exit 1"
    robots.script("r0", "journalctl", f'case "$*" in *--unit=swarm-bus.service*) ;; *) {no_data} ;; esac')
    assert run(*command) == 0


def test_a_journal_that_broke_has_nothing_twice(robots: FakeRobots, run: Run) -> None:
    home = add(robots, "r0", {})
    into = robots.folder / "here"
    assert run("fetch", "--into", str(into)) == 0
    with (into / "journal/r0.log").open("a") as file:
        file.write("half a line that came before the power went")
    (home / "entries").write_text("3")
    assert run("fetch", "--into", str(into)) == 0
    lines = (into / "journal/r0.log").read_text().splitlines()
    assert [line.rpartition(" ")[2] for line in lines] == ["1", "2", "3"]
    (into / "journal/r0.log").unlink()
    assert run("fetch", "--into", str(into)) == 0
    assert len((into / "journal/r0.log").read_text().splitlines()) == 3
    assert json.loads(json.dumps((into / "journal/r0.mark").read_text())).endswith("i=3\n")
