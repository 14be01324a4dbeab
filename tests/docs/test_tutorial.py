"""The tutorial's files and commands, in its order."""

import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"

BLOCK = re.compile(r"^```(\w+) ?([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks() -> list[tuple[str, str, str]]:
    """Language, what stands beside it, and text of every fenced block."""
    return [(m[1], m[2], m[3]) for m in BLOCK.finditer(TUTORIAL.read_text())]


def commands_on_the_path(folder: Path) -> dict[str, str]:
    """An environment in which `swarm`, `pytest` and `python` are this checkout's."""
    for name, module in (("swarm", "-m laptop.cli"), ("pytest", "-m pytest -p no:cacheprovider"), ("python", "")):
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec {sys.executable} {module} "$@"\n')
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
    root = str(TUTORIAL.parents[1])
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "PYTHONPATH": root, "MPLBACKEND": "Agg"}


def work_through(tmp_path: Path, *, slow: bool) -> int:
    """Write its files and run its commands; returns how many commands were run."""
    tools, home = tmp_path / "tools", tmp_path / "home"
    tools.mkdir()
    home.mkdir()
    environment = commands_on_the_path(tools)
    count = 0
    for language, beside, text in blocks():
        if language == "python":
            assert beside, "a file's name stands beside ```python"
            (home / beside).write_text(text)
        elif language == "sh" and (beside == "slow") == slow:
            for line in text.splitlines():
                command, _, comment = line.partition("#")
                code = int(comment.removeprefix(" exit code ")) if comment.startswith(" exit code ") else 0
                done = subprocess.run(
                    ["/bin/sh", "-c", command], cwd=home, env=environment, capture_output=True, text=True, check=False,
                    timeout=100,
                )  # fmt: skip
                assert done.returncode == code, f"{command}\n{done.stdout}\n{done.stderr}"
                count += 1
    return count


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_tutorial_works_as_it_stands(tmp_path: Path) -> None:
    assert work_through(tmp_path, slow=False) >= 8
    for picture in ("descent.png", "states.png"):
        assert (tmp_path / "home" / picture).stat().st_size > 5000


@pytest.mark.slow
def test_its_swarm_of_real_processes_works(tmp_path: Path) -> None:
    assert work_through(tmp_path, slow=True) == 1


def test_every_block_is_of_a_kind_that_is_run() -> None:
    assert {language for language, _, _ in blocks()} == {"sh", "python"}
    assert {beside for language, beside, _ in blocks() if language == "sh"} == {"", "slow"}
