"""What an app is made of: its file, and the modules beside it that it imports."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from services.apps import loader, sources
from services.apps.__main__ import _escaped
from sim.scenario.imports import missing_imports

APP = """
from typing import TYPE_CHECKING
import json, near.deep
from swarm import SyncApp
if TYPE_CHECKING:
    import typed
class Mine(SyncApp):
    x: float = 0.0
    def step(self, neighbours):
        import late
"""


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder / "mine.py"


def test_an_app_is_its_file_and_what_it_imports_from_beside_it_and_those_in_turn(tmp_path: Path) -> None:
    app = write(
        tmp_path,
        {
            "mine.py": APP,
            "near/__init__.py": "",
            "near/deep.py": "from . import other\nimport further",
            "near/other.py": "import numpy.linalg",
            "further.py": "import mine, scipy",
            "late.py": "this is no Python",
            "typed.py": "",
            "json.txt": "",
            "unused.py": "",
        },
    )
    assert list(sources.of_app(app)) == [
        "further.py", "late.py", "mine.py", "near/__init__.py", "near/deep.py", "near/other.py",
    ]  # fmt: skip
    said = missing_imports(str(app), ["SciPy>=1.0"])
    assert said == [
        f"{tmp_path}/near/other.py, line 1: import of numpy.linalg: robots lack it, "
        "if [robot] packages of swarm.toml does not name it"
    ]
    (tmp_path / "mine.py").write_text("import laptop.runs")
    assert missing_imports(str(app)) == [
        f"{tmp_path}/mine.py, line 1: import of laptop.runs: robots lack it, "
        "which is for laptops alone: import it in a script beside the app"
    ]


def test_the_digest_of_an_app_changes_with_each_of_its_files_and_no_other(tmp_path: Path) -> None:
    app = write(tmp_path, {"mine.py": APP, "near/__init__.py": "", "near/deep.py": "", "late.py": "", "unused.py": ""})
    first = loader.load(str(app)).digest
    (tmp_path / "unused.py").write_text("a = 1")
    assert loader.load(str(app)).digest == first
    (tmp_path / "late.py").write_text("a = 1")
    assert loader.load(str(app)).digest != first


@given(st.dictionaries(st.text("abc", min_size=1), st.binary(max_size=9), max_size=4), st.data())
def test_two_apps_have_one_digest_where_all_of_their_files_are_the_same(files: dict[str, bytes], data: st.DataObject):
    other = data.draw(st.dictionaries(st.text("abc", min_size=1), st.binary(max_size=9), max_size=4))
    assert (sources.digest(files) == sources.digest(other)) == (files == other)
    assert sources.digest(dict(reversed(files.items()))) == sources.digest(files)


@given(st.binary(max_size=60))
def test_whatever_stands_in_a_file_its_imports_are_found_or_none(source: bytes) -> None:
    assert all(line > 0 for line, _ in sources.imports(source))


def test_a_setting_that_was_escaped_is_what_was_meant() -> None:
    assert _escaped("r1.text=a%20%27b%27").value == "a 'b'"
