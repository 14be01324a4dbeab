"""Each kind of picture from a recording, made under virtual time: it is drawn, and what cannot be drawn is said."""

import pytest

from services.sim.virtual.run import simulate
from swarm.cli import main

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    press = ("--press", "r0.A@1s", "--press", "r1.B@2s")
    for app, *options in (
        ("localization", "--robots", "3", "--iterations", "15"),
        ("led_sync", "--robots", "3", "--seconds", "6"),
        ("flooding_demo", "--robots", "4", "--seconds", "4", *press),
        ("unicast_demo", "--robots", "4", "--seconds", "4", *press),
        ("stand_up", "--robots", "2", "--seconds", "8", "--press", "r1.A@1s"),
    ):
        simulate(app, *options, "--record", str(folder / app))
    return folder


def plot(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(["plot", *map(str, arguments)])
    return ended.value.code


@pytest.mark.parametrize(
    ("app", "kind"),
    [
        ("localization", "map"),
        ("localization", "states"),
        ("localization", "iterations"),
        ("localization", "mesh"),
        ("led_sync", "leds"),
        ("led_sync", "states"),
        ("flooding_demo", "floods"),
        ("unicast_demo", "unicasts"),
        ("stand_up", "standup"),
    ],
)
def test_every_kind_is_drawn(runs, tmp_path, app, kind):
    path = tmp_path / "picture.svg"
    assert plot(runs / app, "--kind", kind, "-o", path) == 0
    text = path.read_text()
    assert "r0" in text  # text stays text
    assert "/ s" in text or "/ m" in text or kind == "mesh"


def test_the_app_says_what_is_drawn(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert plot(runs / "led_sync") == 0
    assert capsys.readouterr().out == "led_sync-leds.png\n"
    assert (tmp_path / "led_sync-leds.png").read_bytes().startswith(b"\x89PNG")


def test_a_column_is_drawn_by_its_name_and_unknown_ones_are_said(runs, tmp_path, capsys):
    assert plot(runs / "localization", "--column", "result.x", "-o", tmp_path / "x.svg") == 0
    assert "result.x" in (tmp_path / "x.svg").read_text()
    assert plot(runs / "localization", "--column", "colour", "-o", tmp_path / "x.svg") == 2
    assert "no such column of states; there are: q[0], q[1]" in capsys.readouterr().err


def test_what_was_not_recorded_cannot_be_drawn(runs, tmp_path, capsys):
    assert plot(runs / "localization", "--kind", "floods", "-o", tmp_path / "x.png") == 2
    assert "no app has sent a flood in this recording" in capsys.readouterr().err
    assert plot(tmp_path) == 2
    assert "there is no recording (*.mcap) in this folder" in capsys.readouterr().err
