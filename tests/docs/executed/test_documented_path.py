"""No command block on the path from the box to standing robots is without a test that runs it, or a reason."""

import re
import subprocess
from pathlib import Path

import pytest
from documented_path import DOCS, FENCE, PAGES, ROOT, TUTORIAL, Block, blocks, commands
from test_tutorial import commands_on_the_path

BLOCKS = [block for page in PAGES for block in blocks(page) if block.language not in ("text", "toml")]


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: f"{block.page}: {block.commands[0]}")
def test_a_block_is_run_or_says_why_not_and_which_test_runs_such_commands(block: Block) -> None:
    assert block.language == "sh"
    assert block.run_by is not None, f"{block.page}: no test runs ```sh {block.label}"
    assert (ROOT / block.run_by).is_file(), block.run_by


@pytest.mark.parametrize("page", PAGES)
def test_no_command_hides_in_an_indented_block(page: str) -> None:
    text = FENCE.sub("", (DOCS / page).read_text(encoding="utf-8"))
    assert re.findall(r"^    +(?:\$ )?(?:swarm|ssh|scp|deploy/release|\./run) .*$", text, re.MULTILINE) == []


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_what_the_tutorial_does_before_there_are_robots_works_as_it_stands(tmp_path: Path, runtime: Path) -> None:
    tools, home = tmp_path / "tools", tmp_path / "home"
    tools.mkdir()
    home.mkdir()
    for page, name in ((TUTORIAL, "swarm.toml"), ("tutorials/own-algorithm.md", "descent.py")):
        (text,) = [each.text for each in blocks(page) if each.label == name]
        (home / name).write_text(text)
    environment = commands_on_the_path(tools, runtime)
    tried = commands(TUTORIAL, "laptop")
    assert len(tried) == 4
    for command in tried:
        done = subprocess.run(
            ["/bin/sh", "-c", command], cwd=home, env=environment, capture_output=True, text=True, check=False,
            timeout=240,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
