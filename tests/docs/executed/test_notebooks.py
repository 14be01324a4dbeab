"""The notebooks of examples/, cell by cell as a kernel runs them: in one namespace, while an event loop runs."""

import ast
import asyncio
import json
import linecache
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[3] / "examples"


def executed(path: Path) -> tuple[dict[str, Any], list[object]]:
    """Run a notebook. Returns its names, and what each code cell ends with, None where that is no expression."""
    notebook = types.ModuleType("__main__")
    shown: list[object] = []

    async def run(text: str, name: str) -> None:
        linecache.cache[name] = len(text), None, text.splitlines(keepends=True), name  # as kernels do, for tracebacks
        tree = ast.parse(text, name)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, name, "exec"), vars(notebook))
        shown.append(eval(compile(ast.Expression(last.value), name, "eval"), vars(notebook)) if last else None)  # type: ignore[attr-defined]

    was = sys.modules["__main__"]
    sys.modules["__main__"] = notebook  # where a kernel's cells define their classes
    try:
        for number, cell in enumerate(json.loads(path.read_text())["cells"]):
            if cell["cell_type"] == "code":
                assert not cell["outputs"], "outputs do not go into the tree"
                asyncio.run(run("".join(cell["source"]), f"/tmp/ipykernel_1/{number}.py"))
    finally:
        sys.modules["__main__"] = was
    return vars(notebook), shown


@pytest.mark.slow
def test_consensus_takes_eight_lines_from_import_to_plot() -> None:
    names, shown = executed(EXAMPLES / "consensus.ipynb")
    cells = json.loads((EXAMPLES / "consensus.ipynb").read_text())["cells"]
    first = next(cell for cell in cells if cell["cell_type"] == "code")
    assert len([line for line in first["source"] if line.strip()]) <= 8
    assert np.allclose(names["run"]["x"][-1], 2.5)
    assert len(shown[0].axes) == 2  # type: ignore[attr-defined]
    assert np.allclose(shown[1], 2.0 / 3.0, rtol=0.01)  # type: ignore[arg-type]


@pytest.mark.slow
def test_failures_and_a_sweep_show_what_the_text_says(capsys: pytest.CaptureFixture[str]) -> None:
    names, shown = executed(EXAMPLES / "faults_and_sweep.ipynb")
    run, table = names["run"], names["table"]
    assert np.isnan(run["q"][-3, 3]).all()
    mean = np.array(names["start"]["q"]).mean(axis=0)
    assert np.allclose(run["q"][40, 3], mean, atol=0.01)
    there = np.isfinite(run["q"][:, 3, 0]).sum()
    assert f"before iteration {there}" in capsys.readouterr().out  # the wait for the robot that is gone
    settled = {(row["topology"], row["gain"]): row["settled"] for row in table.rows}
    assert settled["full", 1.0] < settled["loop", 1.0] < settled["line", 1.0]
    assert "settled after" in repr(shown[2])
    # One panel: `Meet` has no error to draw.
    assert [axes.get_ylabel() for axes in shown[3].axes] == ["iterations to settle"]  # type: ignore[attr-defined]
