"""Parameters of apps on a command line, above those of swarm.toml."""

import pytest

from swarm.app.settings import Setting, on_top, parse
from swarm.config.types import AppConfig
from swarm.errors import AppError, ConfigError

NAMES = ("r0", "r1", "r2")


@pytest.mark.parametrize(
    ("text", "setting"),
    [
        ("value=0.5", Setting(None, "value", 0.5)),
        ("r2.value=3", Setting("r2", "value", 3)),
        ("text=a.b=c", Setting(None, "text", "a.b=c")),
        ("r1.on=true", Setting("r1", "on", True)),
        ("x=[1,2]", Setting(None, "x", (1.0, 2.0))),
        ("P=[[1, 2],[3,4]]", Setting(None, "P", (1.0, 2.0, 3.0, 4.0))),
        ("T=[[[1],[2]],[[3],[4]]]", Setting(None, "T", (1.0, 2.0, 3.0, 4.0))),
    ],
)
def test_a_setting_is_read(text: str, setting: Setting) -> None:
    assert parse(text) == setting
    assert parse(setting.text) == setting


@pytest.mark.parametrize("text", ["value", "=3", "r2.=3", ".value=3", "a b=3", "x=[a]", "x=[[1,2],[3]]", "x=[[1,2]"])
def test_what_is_none_is_named(text: str) -> None:
    with pytest.raises(AppError, match="is not a"):
        parse(text)


def test_settings_are_above_the_file_and_later_ones_above_earlier() -> None:
    app = AppConfig({"gain": 1.0, "value": 2.0}, {"r1": {"value": 5.0, "gain": 9.0}})
    found = on_top(app, [parse("value=3"), parse("r2.value=4"), parse("r2.value=6")], NAMES)
    assert found == AppConfig({"gain": 1.0, "value": 3}, {"r1": {"gain": 9.0}, "r2": {"value": 6}})
    with pytest.raises(ConfigError, match=r"--set r7\.value: the robots are r0, r1, r2"):
        on_top(app, [parse("r7.value=1")], NAMES)


def test_a_setting_of_one_robot_holds_wherever_it_stands_and_one_of_all_robots_is_above_the_files() -> None:
    app = AppConfig({}, {"r2": {"value": 7.0}})
    for texts in (("r1.value=4", "value=3"), ("value=3", "r1.value=4")):
        found = on_top(app, map(parse, texts), NAMES)
        assert [found.of(name)["value"] for name in ("r0", "r1", "r2")] == [3, 4, 3]
