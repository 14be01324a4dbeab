"""The Python that stands on pages about simulation and recordings runs as it stands, block after block; the tables of
swarm.toml on all pages are such that a configuration takes them. No page has Python that no test runs, but for blocks
that say why."""

import re
from pathlib import Path

import pytest
from documented_path import SHOWN, blocks

from swarm import simulate
from swarm.config import parse

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
CONFIGURATION = """
network = "lab"
robots = [{ name = "r0" }, { name = "r1" }, { name = "r2" }]
topology = { shape = "line" }
"""
TOML = re.compile(r"^```toml\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


RUN_BY = {
    "tests/docs/executed/test_python_blocks.py": ["how-to/simulation/from-python.md", "tutorials/notebook.md"],
    "tests/docs/executed/test_tutorial.py": ["index.md", "how-to/apps/max-consensus.md", "tutorials/own-algorithm.md"],
    "tests/docs/executed/test_connect_page.py": [
        "how-to/runs/export.md", "how-to/tools/zenoh-client.md", "reference/overlays-client.md",
    ],
    "tests/services/apps/test_loader.py": [
        "how-to/apps/react-to-events.md", "how-to/apps/talk-beyond-neighbours.md", "how-to/apps/use-arrays.md",
        "reference/apps.md",
    ],
}  # fmt: skip
"""The pages that have Python, by the tests that run it."""


def test_no_page_has_python_that_no_test_runs() -> None:
    for test, pages in RUN_BY.items():
        text = (ROOT / test).read_text()
        assert [page for page in pages if page not in text] == [], test
    run = {page for pages in RUN_BY.values() for page in pages}
    for page in sorted(DOCS.rglob("*.md")):
        if str(page.relative_to(DOCS)) in run:
            continue
        for block in blocks(page):
            if block.language == "python":
                shown = SHOWN.fullmatch(block.label)
                assert shown is not None, f"{page}: no test runs its Python"
                assert (ROOT / shown[2]).is_file()


def test_the_app_with_arrays_of_the_page_about_apps_runs() -> None:
    text = next(block for block in BLOCK.findall((DOCS / "how-to/apps/use-arrays.md").read_text()) if "Array" in block)
    names: dict[str, object] = {"__name__": "__main__"}
    exec(compile(text, "how-to/apps/use-arrays.md", "exec"), names)
    run = simulate(names["Filter"], robots=3, topology="full", values={"y": [[3.0, 0], [0, 3], [0, 0]]}, iterations=20)  # type: ignore[arg-type]
    assert run["x"][-1] == pytest.approx(1.0)


def test_the_blocks_about_simulation_from_python_run(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = BLOCK.findall((DOCS / "how-to/simulation/from-python.md").read_text())
    assert len(blocks) == 2
    names: dict[str, object] = {"__name__": "__main__"}
    for block in blocks:
        exec(compile(block, "from-python.md", "exec"), names)
    said = capsys.readouterr().out
    assert said.startswith("[2.5 2.5 2.5 2.5 2.5 2.5]")
    assert "settled after" in said


@pytest.mark.slow
def test_the_cells_of_the_tutorial_about_notebooks_run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    names: dict[str, object] = {"__name__": "__main__"}
    for cell in BLOCK.findall((DOCS / "tutorials/notebook.md").read_text()):
        path = tmp_path / "cell.py"  # the class that a cell defines is looked up by its source
        path.write_text(cell)
        exec(compile(cell, path, "exec"), names)
    said = capsys.readouterr().out.splitlines()
    assert said[0].endswith("[2.5 2.5 2.5 2.5 2.5 2.5]")
    assert said[1] == "True True"
    assert "settled after" in "".join(said)


def test_the_blocks_about_recordings_run(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for app, length in (("consensus", {"iterations": 20}), ("led_sync", {"seconds": 2.0})):
        simulate(app, robots=3, topology="line", **length).save(tmp_path / "runs" / app)  # type: ignore[arg-type]
    (tmp_path / "runs" / "led_sync").rename(tmp_path / "runs" / "leds")
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in BLOCK.findall((DOCS / "how-to/runs/export.md").read_text()) if "runs/" in block]
    assert len(blocks) == 2
    for block in blocks:
        exec(compile(block, "export.md", "exec"), {"__name__": "__main__"})
    said = capsys.readouterr().out
    assert "(21, 3)" in said
    assert "r2" in said


@pytest.mark.parametrize("page", [each for each in sorted(DOCS.rglob("*.md")) if TOML.search(each.read_text())])
def test_tables_of_a_page_are_such_that_a_configuration_takes_them(page: Path) -> None:
    for text in TOML.findall(page.read_text()):
        assert parse(CONFIGURATION + text, page, addressed=False).names == ("r0", "r1", "r2")
