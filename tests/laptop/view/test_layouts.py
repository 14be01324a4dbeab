"""Layouts that the server keeps: whatever is asked, the file holds what can be read back."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.view.layouts import MAX_LAYOUTS, Layouts
from swarm.errors import LocalError

PANELS = st.lists(
    st.tuples(st.sampled_from(["map", "values"]), st.integers(1, 6), st.integers(1, 6)), min_size=1, max_size=9
)
NAMES = st.text(st.characters(codec="utf-8", categories=["L", "N"]), min_size=1, max_size=40)


@given(st.dictionaries(NAMES, PANELS, min_size=1, max_size=5))
def test_a_server_started_anew_finds_the_layouts_and_the_one_used_last(
    tmp_path_factory: pytest.TempPathFactory, kept: dict[str, list[tuple[str, int, int]]]
) -> None:
    path = tmp_path_factory.mktemp("layouts") / "swarm" / "view.json"
    layouts = Layouts(path)
    for name, panels in kept.items():
        layouts.keep({"name": name, "panels": [list(each) for each in panels]})
    again = Layouts(path)
    assert again.named == kept
    assert again.current == list(kept)[-1]
    again.keep({"name": ""})
    again.keep({"name": next(iter(kept)), "panels": None})
    assert next(iter(kept)) not in Layouts(path).named
    assert Layouts(path).current == ""


def test_two_servers_of_a_user_keep_the_layouts_of_each_other(tmp_path: Path) -> None:
    one, other = Layouts(tmp_path / "view.json"), Layouts(tmp_path / "view.json")
    one.keep({"name": "mine", "panels": [["map", 1, 1]]})
    other.keep({"name": "theirs", "panels": [["values", 1, 1]]})
    assert sorted(Layouts(tmp_path / "view.json").named) == ["mine", "theirs"]


@pytest.mark.parametrize(
    "asked",
    [
        None,
        {},
        {"name": 3},
        {"name": "not there"},
        {"name": "", "panels": [["map", 1, 1]]},
        {"name": "x" * 41, "panels": [["map", 1, 1]]},
        {"name": "\n", "panels": [["map", 1, 1]]},
        {"name": "x", "panels": []},
        {"name": "x", "panels": [["map", 0, 1]]},
        {"name": "x", "panels": [["map", True, 1]]},
        {"name": "x", "panels": [["../x", 1, 1]]},
        {"name": "x", "panels": [["map", 1]]},
        {"name": "x", "panels": [["map", 1, 1]] * 25},
    ],
)
def test_what_is_no_layout_is_refused_and_nothing_is_written(tmp_path: Path, asked: Any) -> None:
    with pytest.raises(LocalError, match="layout"):
        Layouts(tmp_path / "view.json").keep(asked)
    assert list(tmp_path.iterdir()) == []


def test_more_layouts_than_are_kept_are_refused(tmp_path: Path) -> None:
    layouts = Layouts(tmp_path / "view.json")
    for number in range(MAX_LAYOUTS):
        layouts.keep({"name": f"n{number}", "panels": [["map", 1, 1]]})
    with pytest.raises(LocalError, match="at most"):
        layouts.keep({"name": "more", "panels": [["map", 1, 1]]})
    assert len(Layouts(tmp_path / "view.json").named) == MAX_LAYOUTS


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"layouts": 3, "current": ""}', "[" * 100_000, '{"layouts": {"": []}}']
)
def test_a_file_that_is_none_costs_no_more_than_its_layouts(tmp_path: Path, text: str) -> None:
    path = tmp_path / "view.json"
    path.write_text(text)
    assert Layouts(path).told() == {"current": "", "layouts": {}}


def test_a_folder_that_takes_no_file_is_named() -> None:
    with pytest.raises(LocalError, match="not kept"):
        Layouts(Path("/proc/nowhere/view.json")).keep({"name": "x", "panels": [["map", 1, 1]]})
