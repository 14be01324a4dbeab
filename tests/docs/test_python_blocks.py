"""The Python that stands on pages about simulation runs as it stands, block after block."""

import re
from pathlib import Path

import pytest

from swarm import simulate

DOCS = Path(__file__).parents[2] / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


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
