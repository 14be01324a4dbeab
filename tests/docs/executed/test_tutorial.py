"""Files and commands of the tutorials, in their order."""

import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from documented_path import SHOWN

DOCS = Path(__file__).parents[3] / "docs"
PAGES = {
    "index.md": (0, ()),
    "tutorials/first-swarm.md": (4, ("first.png", "second.png")),
    "tutorials/own-algorithm.md": (8, ("descent.png", "states.png")),
    "how-to/apps/max-consensus.md": (2, ()),
}
"""Pages whose files and commands are run: the fewest quick commands of each, and the pictures that they make."""
WITH_PROCESSES = ("index.md", "tutorials/first-swarm.md", "tutorials/own-algorithm.md")

BLOCK = re.compile(r"^```(\w+) ?([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: str) -> list[tuple[str, str, str]]:
    """Language, what stands beside it, and text of every fenced block."""
    return [(m[1], m[2], m[3]) for m in BLOCK.finditer((DOCS / page).read_text())]


def commands_on_the_path(folder: Path, runtime: Path) -> dict[str, str]:
    """An environment in which `swarm`, `z_sub`, `pytest` and `python` are this checkout's, and simulations no other
    test's."""
    programs = (
        ("swarm", "-m laptop.cli"), ("z_sub", "-m laptop.cli.z_sub"), ("python", ""),
        ("pytest", "-m pytest -p no:cacheprovider"),
    )  # fmt: skip
    for name, module in programs:
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec {sys.executable} {module} "$@"\n')
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
    root = str(DOCS.parent)
    own = {"PATH": f"{folder}:{os.environ['PATH']}", "PYTHONPATH": root, "MPLBACKEND": "Agg"}
    return {**os.environ, **own, "XDG_RUNTIME_DIR": str(runtime)}


def work_through(page: str, tmp_path: Path, runtime: Path, *, slow: bool) -> int:
    """Write its files and run its commands; returns how many commands were run."""
    tools, home = tmp_path / "tools", tmp_path / "home"
    tools.mkdir()
    home.mkdir()
    environment = commands_on_the_path(tools, runtime)
    count = 0
    for language, beside, text in blocks(page):
        if language == "python":
            assert beside, "a file's name stands beside ```python"
            (home / beside).write_text(text)
        elif language == "sh" and beside == ("slow" if slow else ""):
            for line in text.replace("\\\n", " ").splitlines():
                command, _, comment = line.partition("#")
                code = int(comment.removeprefix(" exit code ")) if comment.startswith(" exit code ") else 0
                done = subprocess.run(
                    ["/bin/sh", "-c", command], cwd=home, env=environment, capture_output=True, text=True, check=False,
                    timeout=240,
                )  # fmt: skip
                assert done.returncode == code, f"{command}\n{done.stdout}\n{done.stderr}"
                count += 1
    return count


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", PAGES)
def test_a_page_works_as_it_stands(page: str, tmp_path: Path, runtime: Path) -> None:
    fewest, pictures = PAGES[page]
    assert work_through(page, tmp_path, runtime, slow=False) >= fewest
    for picture in pictures:
        assert (tmp_path / "home" / picture).stat().st_size > 5000


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PROCESSES)
def test_its_swarm_of_real_processes_works(page: str, tmp_path: Path, runtime: Path) -> None:
    assert work_through(page, tmp_path, runtime, slow=True) == 1


@pytest.mark.parametrize("page", PAGES)
def test_every_block_is_of_a_kind_that_is_run(page: str) -> None:
    assert {language for language, _, _ in blocks(page)} == {"sh", "python"} - (
        {"python"} if "first" in page else set()
    )
    shown = {beside for _, beside, _ in blocks(page) if SHOWN.fullmatch(beside)}
    assert {beside for language, beside, _ in blocks(page) if language == "sh"} - shown <= {"", "slow"}


def test_a_reader_can_do_all_tutorials_in_one_folder() -> None:
    pages = sorted((DOCS / "tutorials").glob("*.md"))
    recorded = [name for page in pages for name in re.findall(r"--record (\S+)", page.read_text())]
    assert len(recorded) > 2
    assert len(set(recorded)) == len(recorded)
