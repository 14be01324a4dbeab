"""Each kind of picture from a recording, made under virtual time: it is drawn, and what cannot be drawn is said."""

import math
import re
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from laptop.cli import main
from laptop.cli.runs.plot import KINDS
from laptop.plotting import style
from laptop.plotting.events import _flashes
from laptop.plotting.journeys import JourneyLeg, Pass, _answers, _arrivals, _heard, _requests, legs
from laptop.plotting.mesh import layout, network, spots
from laptop.plotting.mesh import mesh as mesh_plot
from laptop.plotting.style import figure
from sim.report import summary
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.recording.run import Run
from swarm.recording.virtual_file import DirectRecording

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
        run_virtually(app, *options, "--record", str(folder / app))
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
    assert re.search(r">x</text>", (tmp_path / "x.svg").read_text())
    assert plot(runs / "localization", "--column", "colour", "-o", tmp_path / "x.svg") == 2
    assert "no such column of states; there are: q[0], q[1]" in capsys.readouterr().err


def test_a_result_is_drawn_by_its_plain_name_and_one_unknown_column_among_known_ones_is_said(runs, tmp_path, capsys):
    path = tmp_path / "x.svg"
    assert plot(runs / "localization", "--column", "x", "-o", path) == 0
    assert re.search(r">x</text>", path.read_text())
    assert plot(runs / "localization", "--column", "x", "--column", "colour", "-o", path) == 2
    assert "got 'colour'" in capsys.readouterr().err


def test_the_map_of_an_authors_app_has_the_target_that_it_ranges_to_and_its_estimates(tmp_path):
    finder = Path(__file__).parents[3] / "examples" / "find_target.py"
    words = ("--robots", "3", "--iterations", "15", "--target-velocity", "0.05,0.02")
    run_virtually(str(finder), *words, "--record", str(tmp_path / "run"))
    path = tmp_path / "map.svg"
    assert plot(tmp_path / "run", "--kind", "map", "-o", path) == 0
    text = path.read_text()
    for label in ("target's way", "estimate", "distance to the true target / cm"):
        assert label in text


@pytest.mark.parametrize("name", ["formation", "led_sync", "stand_up"])
def test_an_authors_app_with_the_name_of_a_built_in_one_is_drawn_as_its_own(tmp_path, name, capsys):
    app = tmp_path / f"{name}.py"
    app.write_text("from swarm import SyncApp\nclass Own(SyncApp):\n    value: float\n    def step(self, n): pass\n")
    report, _ = run_virtually(str(app), "--robots", "2", "--iterations", "3", "--record", str(tmp_path / "run"))
    assert report["problems"] == []
    path = tmp_path / "picture.svg"
    assert plot(tmp_path / "run", "-o", path) == 0
    assert "iteration" in path.read_text()
    assert plot(tmp_path / "run", "--kind", "map", "-o", path) == 0


def test_an_axis_says_what_it_was_told(runs, tmp_path, capsys):
    path = tmp_path / "x.svg"
    assert plot(runs / "localization", "--column", "result.x", "--label", "result.x=target x / m", "-o", path) == 0
    assert "target x / m" in path.read_text()
    assert plot(runs / "localization", "--label", "nonsense", "-o", path) == 2
    assert "expected NAME=TEXT" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["states", "iterations", "mesh", "leds"])
def test_no_legend_hides_data(runs, kind):
    """Legends stand outside of the axes they belong to."""
    with figure(Path("unused.pdf"), settings=style.RC, layout="constrained") as made:
        KINDS[kind](made, Run(runs / "led_sync"))
        made.canvas.draw()
        for axes in made.axes:
            if (legend := axes.get_legend()) is not None:
                shown, inside = legend.get_window_extent(), axes.get_window_extent()
                assert shown.x0 >= inside.x1 - 1 or shown.y0 >= inside.y1 - 1
        made.savefig = lambda *args, **options: None


class LinksAlone:
    """A recording that holds the `mesh/links` of some robots: (robot, {peer: messages dropped})."""

    def __init__(self, *told):
        self.path = Path("links")
        self.told = told

    def samples(self, topic):
        for t, (robot, dropped) in enumerate(self.told if topic.endswith("mesh/links") else ()):
            links = [{"peer": peer, "state": "up", "rtt": 0.05, "dropped": count} for peer, count in dropped.items()]
            yield SimpleNamespace(topic=f"swarm/{robot}/mesh/links", message={"links": links}, t=float(t))


@pytest.mark.parametrize("name", ["r{}", "robot-number-{:03d}"])
def test_a_legend_is_no_wider_than_its_axes_and_takes_no_room_from_them(name):
    with figure(None, settings=style.RC, layout="constrained") as made:
        made.set_size_inches(7.2, 2.9)
        grid = made.add_gridspec(1, 2)
        left, right = (made.add_subplot(each) for each in grid)
        for robot in range(style.FEW):
            left.plot([0.0, 1.0], [0.0, robot], label=name.format(robot))
        right.plot([0.0, 1.0], [0.0, 1.0])
        style.legend(left, style.FEW)
        made.draw_without_rendering()
        assert left.get_position().width > 0.4
        assert left.get_legend().get_window_extent().x1 <= right.get_window_extent().x0


def test_a_long_name_stands_beside_its_robot_in_the_mesh_and_not_across_its_rim():
    with figure(None) as made:
        network(made, {"r0": (0.0, 0.0), "robot-number-001": (1.0, 0.0)}, {})
        made.draw_without_rendering()
        (axes,) = made.axes
        offset = {each.get_text(): each.xyann for each in axes.texts}
    assert offset == {"r0": (0.0, 0.0), "robot-number-001": (0.0, -12.0)}


def test_the_mesh_is_drawn_without_links_that_are_gone_and_counts_drops_over_restarts():
    run = LinksAlone(("r0", {"r1": 10, "r2": 0}), ("r1", {"r0": 0}), ("r0", {"r1": 40}), ("r0", {"r1": 2}))
    with figure(Path("unused.pdf"), settings=style.RC, layout="constrained") as made:
        mesh_plot(made, run)
        texts = [text.get_text() for axes in made.axes for text in axes.texts]
        made.savefig = lambda *args, **options: None
    assert "50 ms\n32 dropped" in texts
    assert "r2" not in texts


def test_a_vector_file_has_text_in_it(runs, tmp_path):
    assert plot(runs / "led_sync", "-o", tmp_path / "leds.pdf") == 0
    assert b"/Type /Font" in (tmp_path / "leds.pdf").read_bytes()


def test_the_moment_a_robot_stands_is_the_apps_own(runs, tmp_path):
    """The body's state is recorded five times a second; the app says when it stood."""
    stood = {
        sample.topic.split("/")[1]: sample.t
        for sample in Run(runs / "stand_up").samples("swarm/*/app/*/record/standing")
        if sample.message["value"]
    }
    assert set(stood) == {"r0", "r1"}
    assert plot(runs / "stand_up", "-o", tmp_path / "x.svg") == 0
    assert all(f"{t:.1f} s" in (tmp_path / "x.svg").read_text() for t in stood.values())


def test_no_tilt_is_drawn_while_a_robot_is_off(tmp_path):
    run_virtually("stand_up", "--robots", "2", "--seconds", "14", "--press", "r1.A@1s", "--off", "r0@5s,4s",
             "--record", str(tmp_path / "run"))  # fmt: skip
    with figure(tmp_path / "x.svg", settings=style.RC) as made:
        KINDS["standup"](made, Run(tmp_path / "run"))
    r0, r1 = made.axes[0].lines
    assert [int(np.isnan(line.get_ydata()).sum()) for line in (r0, r1)] == [1, 0]
    filled = [len(each.get_paths()) for each in made.axes[0].collections]
    assert filled == [2, 1]


def test_a_messages_way_is_that_of_the_robots_that_tell_of_it():
    out = [Pass(0.0, "r0", "r1", False), Pass(0.03, "r1", "r2", False)]
    back = [Pass(0.06, "r2", "r3", True), Pass(0.09, "r3", "r0", True)]
    assert legs([*back, *out], "r0", "r2", 0.061, 0.12) == [
        JourneyLeg(0.0, "r0", "r1", False, 0.03),
        JourneyLeg(0.03, "r1", "r2", False, 0.06),
        JourneyLeg(0.06, "r2", "r3", True, 0.09),
        JourneyLeg(0.09, "r3", "r0", True, 0.12),
    ]


def test_what_was_lost_on_a_link_arrived_by_the_next_try():
    lost = Pass(0.0, "r0", "r1", False)
    again = Pass(0.2, "r0", "r1", False)
    assert legs([lost, again], "r0", "r1", 0.23, None) == [JourneyLeg(*lost, None), JourneyLeg(*again, 0.23)]
    assert legs([lost], "r0", "r1", None, None) == [JourneyLeg(*lost, None)]


def test_of_two_answers_the_sender_heeds_one():
    out = [Pass(0.0, "r0", "r1", False), Pass(0.1, "r0", "r1", False)]
    back = [Pass(0.13, "r1", "r0", True), Pass(0.13, "r1", "r0", True)]
    found = legs([*out, *back], "r0", "r1", 0.13, 0.16)
    assert [(it.t, it.until) for it in found] == [(0.0, 0.13), (0.1, 0.13), (0.13, 0.16)]


def test_robots_clocks_may_differ_a_little():
    passes = [Pass(1.0, "r0", "r1", False), Pass(0.995, "r1", "r2", False)]
    assert [it.until for it in legs(passes, "r0", "r2", 1.03, None)] == [1.03, 0.995]


def test_a_recorded_message_is_followed_over_all_links(runs):
    """Thesis figure 3.16: on a line of four r1 sends to r3 over r2."""
    run = Run(runs / "unicast_demo")
    passes = [
        (sample.topic.split("/")[1], it["next"], it["back"])
        for sample in run.samples("swarm/*/mesh/passed")
        if (it := sample.message)["sender"] == "r1"
    ]
    assert passes == [("r1", "r2", False), ("r2", "r3", False), ("r3", "r2", True), ("r2", "r1", True)]


def test_a_target_that_moves_is_drawn_on_its_way(tmp_path):
    record = tmp_path / "run"
    moving = ("--algorithm", "moving", "--target-velocity", "0.1,0.05", "--seconds", "4")
    _, outcome = run_virtually("localization", *moving, "--record", str(record))
    run = Run(record)
    way = [(sample.message["x"], sample.message["y"]) for sample in run.samples("swarm/r0/sim/target")]
    assert way[0] == (0.5, 1.0)
    assert way[-1] == pytest.approx((0.9, 1.2), abs=0.03)
    assert math.dist(way[-1], outcome.targets()["r0"]) < 0.03
    assert plot(record, "-o", tmp_path / "x.svg") == 0
    text = (tmp_path / "x.svg").read_text()
    assert "target's way" in text
    assert "where the target was then" in text


RING = [("r0", "r1"), ("r1", "r2"), ("r2", "r3"), ("r0", "r3")]
SQUARE = {"r0": (0.0, 0.0), "r1": (1.0, 0.0), "r2": (1.0, 1.0), "r3": (0.0, 1.0)}


def test_robots_are_drawn_where_they_are_unless_that_misleads():
    names = sorted(SQUARE)
    assert layout(names, RING, SQUARE) == SQUARE
    circle = layout(names, RING, {})
    assert circle["r0"] == (0.0, 1.0)
    near = SQUARE | {"r2": (1.05, 0.05)}  # hides r1
    beside = SQUARE | {"r2": (0.5, 0.02)}  # seems to be on the link of r0 and r1
    for misleading in (near, beside):
        assert layout(names, RING, misleading) == circle


def test_words_of_links_that_cross_stand_apart():
    links = [("r0", "r2"), ("r1", "r3"), *RING]
    found = spots(SQUARE, links)
    assert set(found) == set(links)
    assert min(math.dist(a, b) for a, b in combinations(found.values(), 2)) > 0.13


def test_each_of_two_floods_under_way_at_once_has_its_own_arrivals(tmp_path):
    press = ("--press", "r0.A@1s", "--press", "r0.B@1.02s", "--press", "r0.C@3s")
    run_virtually("flooding_demo", "--robots", "4", "--seconds", "4", *press, "--record", str(tmp_path))
    run = Run(tmp_path)
    found = _arrivals(_requests(run), _answers(run), _heard(run))
    assert [sorted(robot for _, robot in each) for each in found.values()] == [["r1", "r2", "r3"]] * 3


def test_what_was_not_recorded_cannot_be_drawn(runs, tmp_path, capsys):
    assert plot(runs / "localization", "--kind", "floods", "-o", tmp_path / "x.png") == 2
    assert "no app has sent a flood in this recording" in capsys.readouterr().err
    assert plot(tmp_path) == 2
    assert "there is no recording (*.mcap) in this folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "span", "said"),
    [
        ("states", (30, 60), r"--between 30 60: expected FROM < TO within 0 s to [\d.]+ s"),
        ("states", (2, 1), "--between 2 1: expected FROM < TO within"),
        ("mesh", (1, 2), "--between: nothing in this picture is drawn over time"),
    ],
)
def test_a_part_of_the_run_in_which_nothing_is_drawn_is_refused(runs, tmp_path, capsys, kind, span, said):
    path = tmp_path / "x.png"
    assert plot(runs / "led_sync", "--kind", kind, "--between", *span, "-o", path) == 2
    assert re.search(said, capsys.readouterr().err)
    assert not path.exists()
    assert plot(runs / "led_sync", "--kind", "states", "--between", 1, 60, "-o", path) == 0


@pytest.mark.parametrize(("skew", "basis"), [("100ppm", "the simulated world"), ("0ppm", "one clock")])
def test_flashes_are_as_far_apart_as_the_world_saw_them(tmp_path, skew, basis):
    """On an axis that follows the mesh clock the LEDs that follow it too would seem to be exact."""
    words = ("--robots", "3", "--seconds", "8", "--jitter", "20ms", "--clock-skew", skew)
    options = parse(["led_sync", *words, "--virtual", "--record", str(tmp_path)])
    simulation = VirtualRun(options, build(options, PLACE))
    report = summary(simulation.go())
    run, seen = Run(tmp_path), simulation._scene_record
    assert seen is not None
    assert run.basis == basis
    flashes, _, source = _flashes(run)
    assert source == "registers of the simulated LEDs"
    for name, times in seen.flashes.items():
        assert flashes[name] == pytest.approx([t - run.origin for t in times], abs=1e-6)
    with figure(tmp_path / "leds.svg", settings=style.RC) as made:
        KINDS["leds"](made, run)
    assert f"registers of the simulated LEDs, by the time of {basis}<" in (tmp_path / "leds.svg").read_text()
    drawn = [abs(y) for line in made.axes[1].lines for x, y in zip(*line.get_data(), strict=True) if x > 4.0]
    told = report["scene"]["apart_all_p95_ms"]
    assert max(drawn) >= 0.5 * told


def test_of_real_robots_the_picture_says_that_its_clock_is_that_of_the_leds(tmp_path):
    for name, offset in (("r0", 0.0), ("r1", 50.0)):
        file = DirectRecording(tmp_path / f"{name}.x.mcap", {"app": "x"}, name)
        for k in range(20):
            t = 100.0 + 0.5 * k - offset
            file.write(f"swarm/{name}/mesh/clock", t, {"t": t, "offset": offset, "rate": 0.0, "root": "r0"}, "Clock")
            lamps = {"t": t, "red": False, "yellow": k % 2 == 0, "green": False}
            file.write(f"swarm/{name}/balancer/leds", t, lamps, "Leds")
        file.close()
    path = tmp_path / "leds.svg"
    assert plot(tmp_path, "--kind", "leds", "-o", path) == 0
    text = " ".join(re.sub("<[^>]*>", " ", path.read_text()).split())  # a note may have several lines
    assert "LEDs as the balancers report them, by the time of the mesh clock" in text
    assert "its errors are not to be seen" in text


def test_flashes_of_a_robot_that_others_went_on_without_are_compared_with_none(tmp_path):
    run_virtually(
        "led_sync", "--robots", "3", "--seconds", "9", "--push", "r0@4s,0.5", "--record", str(tmp_path / "run")
    )
    with figure(tmp_path / "leds.svg", settings=style.RC) as made:
        KINDS["leds"](made, Run(tmp_path / "run"))
    below = made.axes[1]
    assert below.get_ylabel() == "flash after that of r1 / ms"
    assert max(abs(y) for line in below.lines for y in line.get_ydata()) < 500
    assert max(below.lines[2].get_xdata()) > 8.0


def test_leds_that_do_not_flash_are_drawn_over_the_whole_run_alone(tmp_path):
    (tmp_path / "lamps.py").write_text(
        "from swarm import SyncApp\n\nclass Lamps(SyncApp):\n    x: int\n\n    def step(self, neighbours):\n"
        "        self.x += 1\n        if self.x == 10 and self.robot.name == 'r1':\n"
        "            self.robot.leds(red=True)\n"
    )
    run_virtually(str(tmp_path / "lamps.py"), "--robots", "2", "--iterations", "40", "--record", str(tmp_path / "run"))
    with figure(tmp_path / "leds.svg", settings=style.RC) as made:
        KINDS["leds"](made, Run(tmp_path / "run"))
    (only,) = made.axes
    (bar,) = only.patches  # it shines to the end
    assert bar.get_x() == pytest.approx(0.4, abs=0.1)
    assert bar.get_x() + bar.get_width() == pytest.approx(1.26, abs=0.1)
