"""The command `swarm`: its verbs, its errors, and that it stays light."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import swarm
from laptop.cli import main
from laptop.cli.commands import SECTIONS
from swarm.config.example import EXAMPLE
from swarm.onboard.command_line import MORE, Command, CommandGroup, commands_of, help_of, names, parser_of

COMMANDS = commands_of(SECTIONS)


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


def test_a_file_without_the_verb_is_refused_with_the_usage(example, capsys):
    assert run("config", str(example)) == 2
    assert "check [FILE]" in capsys.readouterr().err


def test_config_check_prints_what_a_file_contains_as_json(example, capsys):
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


def test_a_file_that_awaits_its_bluetooth_addresses_is_fine_and_says_so(tmp_path, capsys):
    path = tmp_path / "swarm.toml"
    robots = "".join(f'[[robots]]\nname = "{name}"\n' for name in ("r0", "r1"))
    path.write_text(f'network = "lab"\n[topology]\nshape = "line"\n{robots}')
    assert run("config", "check", str(path)) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no Bluetooth address yet: r0 r1; swarm pair writes them"
    assert run("config", "check", "--json", str(path)) == 0
    assert json.loads(capsys.readouterr().out)["unaddressed"] == ["r0", "r1"]
    assert run("sim", "consensus", "--virtual", "--iterations", "3", "--config", str(path)) == 0


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
def test_wrong_arguments_end_with_2_and_the_usage(arguments, capsys):
    assert run("config", *arguments) == 2
    assert "swarm config" in capsys.readouterr().err


def test_an_unknown_command_is_refused_with_the_one_that_is_meant(capsys):
    assert run("confg") == 2
    assert capsys.readouterr().err == "swarm: no command 'confg'; did you mean config?\n"
    assert run("press", "r0", "A") == 2
    assert capsys.readouterr().err == "swarm: no command 'press'; did you mean hand press?\n"
    assert run("hand", "prod") == 2
    assert "no command 'hand prod'; there are hand press, hand push" in capsys.readouterr().err
    assert run("xyz") == 2
    assert f"there are {', '.join(COMMANDS)}" in capsys.readouterr().err


def test_help_lists_every_command_and_fits_a_screen(capsys):
    assert run("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    *lines, more = lines
    listed = [line.split()[0] for line in lines if line.startswith("  ")]
    assert listed + more.removeprefix("more: ").split(", ") == list(COMMANDS)
    assert len(lines) < 40
    assert max(map(len, lines)) <= 100
    assert len(lines) <= 52
    assert run() == 2


def test_a_verb_that_is_left_out_is_the_one_that_shows(tmp_path, capsys):
    for words in (("mesh", "topology"), ("mesh", "epoch", "--app", "consensus")):
        assert run(*words, "--run-dir", str(tmp_path)) == 2
        assert capsys.readouterr().err == f"swarm: no simulation is running in {tmp_path}\n"


@pytest.mark.parametrize("group", [name for name, each in COMMANDS.items() if isinstance(each, CommandGroup)])
def test_help_of_a_group_lists_its_commands(group, capsys):
    assert run(group, "--help") == 0
    text = capsys.readouterr().out
    assert all(f"\n  {name} " in text for name in COMMANDS[group].commands)


@pytest.mark.parametrize(
    "words",
    [
        ("view", "--port", "99999"),
        ("foxglove", "--port", "-1"),
        ("view", "run", "--screenshot", "x.png", "--at", "nan"),
        ("film", "run", "x.mp4", "--from", "nan"),
        ("film", "run", "x.mp4", "--to", "inf"),
        ("replay", "run", "--start", "nan"),
        ("sim", "consensus", "--seconds", "0"),
        ("dwm", "check", "--seconds", "0"),
        ("calibrate", "distance", "--robots", "r0", "--step", "0"),
    ],
)
def test_a_number_that_is_none_of_its_kind_is_named(words, capsys):
    assert run(*words) == 2
    assert f"argument {words[-2]}: '{words[-1]}': expected a " in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [("run", "consensus", "--iterations", "0"), ("calibrate", "distance", "--count", "0")]
)
def test_a_number_with_which_nothing_would_be_done_is_refused(words, capsys):
    assert run(*words) == 2
    assert f"argument {words[-2]}: '0': expected 1 or more, a whole number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (("replay", "run", "--json", "swarm/r0/**", "swarm/r1/**"), "keys", ["swarm/r0/**", "swarm/r1/**"]),
        (("app start", "start", "consensus", "--json", "r1"), "which", ["r1"]),
        (("mesh epoch", "drop", "r1", "--app", "consensus", "r2"), "which", ["r1", "r2"]),
        (("estop", "stop", "it", "--json", "burns"), "reason", "it burns"),
    ],
)
def test_words_stand_behind_options_too(words, name, value):
    group, _, sub = words[0].partition(" ")
    command = COMMANDS[group].commands[sub] if sub else COMMANDS[group]
    assert getattr(parser_of(words[0], command).parse_args(words[1:]), name) == value


@pytest.mark.parametrize("words", [("config", "check"), ("key", "new"), ("calibrate", "samples")])
def test_words_that_are_too_many_are_refused_with_the_usage_of_the_verb(words, capsys):
    assert run(*words, "a", "b", "c") == 2
    shown = capsys.readouterr().err
    assert shown.startswith(f"usage: swarm {' '.join(words)} [-h]")
    assert "unrecognized arguments: " in shown


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (("status", "--wach"), "--watch"),
        (("new", "app.py", "--knd", "sync"), "--kind"),
        (("check", "consensus", "--iteratoins=4"), "--iterations"),
        (("discover", "--secnds", "3"), "--seconds"),
        (("key", "new", "--jsn"), "--json"),
        (("sim", "consensus", "--vrtual"), "--virtual"),
    ],
)
def test_an_unknown_option_is_refused_with_the_one_that_is_meant(words, near, capsys):
    assert run(*words) == 2
    assert capsys.readouterr().err.endswith(f"; did you mean {near}?\n")
    assert run(*words[:1], "--qqq") == 2
    assert "did you mean" not in capsys.readouterr().err


def test_options_of_a_shell_command_without_quotes_are_refused_with_an_example(capsys):
    assert run("command", "ls", "-l") == 2
    assert "in quotes: swarm command 'ls -l'" in capsys.readouterr().err


def test_a_picture_of_a_kind_that_is_not_written_is_refused_with_those_that_are(tmp_path, capsys):
    assert run("view", "run", "--screenshot", str(tmp_path / "x.jpg")) == 2
    assert "x.jpg': a picture is a file that ends in .png\n" in capsys.readouterr().err
    assert run("plot", "run", "-o", str(tmp_path / "x.jpg")) == 2
    assert "x.jpg': a picture is a file that ends in .png, .pdf, .svg\n" in capsys.readouterr().err


def test_a_running_swarm_has_no_picture_of_the_past(tmp_path, capsys):
    assert run("view", "--run-dir", str(tmp_path), "--screenshot", str(tmp_path / "x.png"), "--at", "3") == 2
    assert capsys.readouterr().err == "swarm: --at is for a recording: a running swarm is shown as it is now\n"


def test_swarm_stop_is_the_same_command_as_estop():
    assert COMMANDS["stop"].module == COMMANDS["estop"].module
    assert [name for name in names(COMMANDS) if name.split()[-1] == "stop"] == ["app stop", "services stop", "stop"]


def test_the_completion_script_completes_commands_and_those_of_groups():
    script = subprocess.run(
        [sys.executable, "-m", "laptop.cli", "completion"], capture_output=True, text=True, check=True
    )
    ask = 'COMP_WORDS=(swarm hand pr); COMP_CWORD=2; _swarm; echo "${COMPREPLY[@]}"'
    done = subprocess.run(["bash", "-c", f"{script.stdout}{ask}"], capture_output=True, text=True, check=True)
    assert done.stdout == "press\n"
    ask = 'COMP_WORDS=(swarm es); COMP_CWORD=1; _swarm; echo "${COMPREPLY[@]}"'
    done = subprocess.run(["bash", "-c", f"{script.stdout}{ask}"], capture_output=True, text=True, check=True)
    assert done.stdout == "estop\n"


def test_the_command_prints_its_version(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"swarm {swarm.__version__}\n"


@pytest.mark.parametrize(("verb", "program"), [("sim", "laptop.cli.runs.sim"), ("demo", "laptop.cli.runs.demo")])
def test_the_program_of_the_simulation_gets_its_arguments_untouched(verb, program, monkeypatch):
    called = []
    monkeypatch.setattr(sys, "argv", ["swarm"])
    monkeypatch.setattr(f"{program}.main", lambda: called.append(sys.argv) or 7)
    assert run(verb, "--help", "--robots", "3", "--", "-x") == 7
    assert called == [["swarm", "--help", "--robots", "3", "--", "-x"]]


SWARM = "from laptop.cli import main; main()"


def test_a_reader_that_leaves_is_no_fault():
    done = subprocess.run(
        ["sh", "-c", '"$0" -c "$1" config --example | true', sys.executable, SWARM],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.stderr == ""


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_command_without_standard_streams_ends_quietly_with_its_code(closed):
    for words, code in (("config --example", 0), ("no-such-command", 2)):
        script = f'"$0" -c "$1" {words} {closed}'
        done = subprocess.run(["sh", "-c", script, sys.executable, SWARM], capture_output=True, text=True, check=False)
        assert done.returncode == code
        assert "Traceback" not in done.stderr


def test_a_full_disk_is_one_line():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", SWARM, "config", "--example"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=240,
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
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, timeout=240, check=True)
    loaded = {name.partition(".")[0] for name in done.stderr.split()}
    assert not loaded & {"zenoh", "numpy", "asyncio", "matplotlib", "services"}


def every_command():
    for each in COMMANDS.values():
        yield from each.commands.values() if isinstance(each, CommandGroup) else [each]


@pytest.mark.parametrize("command", [each for each in every_command() if not each.help], ids=lambda each: each.module)
def test_the_help_of_a_command_is_that_of_its_module(command: Command):
    assert help_of(command) == importlib.import_module(command.module).HELP


def test_help_imports_no_command():
    look = (
        "import sys; from laptop.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: sys.stderr.write(' '.join(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, timeout=240, check=True)
    assert [name for name in done.stderr.split() if name.startswith("laptop.cli.")] == ["laptop.cli.commands"]
    assert all(f"\n  {name:<10} " in done.stdout for name in COMMANDS if name not in SECTIONS[MORE])
