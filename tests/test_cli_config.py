"""The command `swarm`: its verbs, its errors, and that it stays light."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import swarm
from laptop.cli import HANDED_ON, MODULES, VERBS, help_of, main
from swarm.config.example import EXAMPLE


def run(*arguments):
    """The exit code of `swarm ARGUMENTS`."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    return caught.value.code


@pytest.fixture
def example(tmp_path):
    path = tmp_path / "swarm.toml"
    path.write_text(EXAMPLE)
    return path


def test_example_can_be_checked(tmp_path, capsys):
    assert run("config", "--example") == 0
    path = tmp_path / "swarm.toml"
    path.write_text(capsys.readouterr().out)
    assert run("config", "check", str(path)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{path}: fine; network lab"
    assert lines[2].split() == ["r0", "zero2w", "rfcomm:B8:27:EB:00:00:10", "r1", "r3", "r4", "r5"]
    assert "links: 9, diameter 2, authenticated by the key in /etc/swarm/key" in lines


def test_check_as_json(example, capsys):
    assert run("config", "check", "--json", str(example)) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["links"] == 9
    assert summary["authenticated"] is True
    assert summary["diameter"] == 2
    assert summary["robots"]["r1"] == {
        "board": "zero2w",
        "link": "rfcomm:B8:27:EB:00:00:11",
        "neighbours": ["r0", "r2"],
    }
    assert summary["anchors"] == ["D001", "D002", "D003"]


def test_check_takes_the_file_of_the_environment(example, capsys, monkeypatch):
    monkeypatch.setenv("SWARM_CONFIG", str(example))
    assert run("config", "check") == 0
    assert str(example) in capsys.readouterr().out


def test_a_wrong_file_is_one_line_on_stderr(example, capsys):
    example.write_text(EXAMPLE.replace("window = 5", "windw = 5"))
    assert run("config", "check", str(example)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == f"swarm: {example}: [dwm] windw: unknown entry; did you mean window?\n"


@pytest.mark.parametrize("arguments", [(), ("--example", "check"), ("chekc",), ("--nonsense",)])
def test_wrong_arguments(arguments, capsys):
    assert run("config", *arguments) == 2
    assert "swarm config" in capsys.readouterr().err


def test_unknown_verb(capsys):
    assert run("confg") == 2
    assert capsys.readouterr().err == "swarm: no command 'confg'; did you mean config?\n"
    assert run("xyz") == 2
    assert f"there are {', '.join([*VERBS, *HANDED_ON])}" in capsys.readouterr().err


def test_help_lists_every_verb(capsys):
    assert run("--help") == 0
    text = capsys.readouterr().out
    assert all(f"\n  {verb} " in text for verb in (*VERBS, *HANDED_ON))
    assert max(map(len, text.splitlines())) <= 100
    assert run() == 2


def test_version(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"swarm {swarm.__version__}\n"


@pytest.mark.parametrize(("verb", "first"), [("sim", []), ("demo", ["--demo"])])
def test_verbs_of_the_simulation_are_handed_on_untouched(verb, first, monkeypatch):
    called = []
    monkeypatch.setattr(os, "execv", lambda *arguments: called.append(arguments) or sys.exit(7))
    assert run(verb, "--help", "--robots", "3", "--", "-x") == 7
    rest = ["--help", "--robots", "3", "--", "-x"]
    assert called == [(sys.executable, [sys.executable, "-m", "laptop.cli.runs.sim", *first, *rest])]


SWARM = "from laptop.cli import main; main()"


def test_a_reader_that_leaves_is_no_fault():
    done = subprocess.run(
        ["sh", "-c", '"$0" -c "$1" config --example | true', sys.executable, SWARM],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == ""


def test_a_full_disk_is_one_line():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", SWARM, "config", "--example"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == "swarm: [Errno 28] No space left on device\n"


def test_nothing_heavy_is_imported():
    look = (
        "import sys; from laptop.cli import main\n"
        "try: main(['config', '--example'])\n"
        "except SystemExit: sys.stderr.write(' '.join(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, timeout=60, check=True)
    loaded = {name.partition(".")[0] for name in done.stderr.split()}
    assert not loaded & {"zenoh", "numpy", "asyncio", "matplotlib", "services"}


@pytest.mark.parametrize("verb", VERBS)
def test_the_help_of_a_verb_is_that_of_its_module(verb):
    assert help_of(verb) == importlib.import_module(f"laptop.cli.{MODULES.get(verb, verb)}").HELP


def test_help_imports_no_verb():
    look = (
        "import sys; from laptop.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: sys.stderr.write(' '.join(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, timeout=60, check=True)
    assert [name for name in done.stderr.split() if name.startswith("laptop.cli.")] == []
    assert all(f"\n  {verb:<9} " in done.stdout for verb in (*VERBS, "sim", "sweep"))
