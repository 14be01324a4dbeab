"""Pictures show what an author marks, counts in steps, and names that keep clear of each other."""

from enum import Enum
from itertools import combinations
from pathlib import Path
from typing import Annotated

import pytest
from numpy import isnan

from swarm import EventApp, Matrix, PeriodicApp, SyncApp, Vector, simulate

figure = pytest.importorskip("matplotlib.figure")


class Marked(SyncApp):
    """Counts, and has a vector."""

    p: Annotated[Vector, 2] = (0.0, 1.0)
    count: int = 0
    plotted = ("spread", "count")

    def step(self, neighbours: object) -> None:
        """Count."""
        self.count += 1

    def result(self) -> dict[str, float]:
        """Something else, and the count again."""
        return {"spread": self.p[1], "count": self.count}


class Steady(PeriodicApp):
    """Steps ten times a second."""

    x: float
    period = 0.1

    def step(self, neighbours: object) -> None:
        """Go on."""
        self.x += 0.1


@pytest.mark.parametrize("skew", [None, "20ppm"])
def test_what_the_author_marks_comes_first_and_counts_are_steps(skew: str | None) -> None:
    """With clocks of their own each robot has a file, as real robots have, and each file names the marked states."""
    made = simulate(Marked, robots=2, iterations=5, progress=False, clock_skew=skew).plot()
    left = made.axes[::2]
    assert [axes.get_ylabel() for axes in left] == ["spread", "count"]
    assert [axes.lines[0].get_drawstyle() for axes in left] == ["default", "steps-post"]


class Ratio(SyncApp):
    """Has single values, a vector, and results of which one repeats the vector."""

    v: Annotated[Vector, 2] = (1.0, 2.0)
    weight: float = 1.0

    def step(self, neighbours: object) -> None:
        """Change nothing."""

    def result(self) -> dict[str, object]:
        """Something that no shared state has, and the vector again."""
        return {"v": self.v, "ratio": self.v[0] / self.weight}


def test_a_picture_shows_errors_single_values_and_vectors_of_states_and_results_once() -> None:
    made = simulate(Ratio, robots=2, iterations=5, progress=False).plot()
    assert [axes.get_ylabel() for axes in made.axes[::2]] == ["weight", "ratio", "v[0]", "v[1]"]


class Lit(Steady):
    """Shares a truth value."""

    x: float
    lit: bool = True


def test_a_truth_value_has_a_gap_where_its_robot_was_off() -> None:
    axes, *_ = simulate(Lit, robots=2, seconds=6, faults=["off r1@2s,2s"], progress=False).plot("lit").axes
    assert [int(isnan(line.get_ydata()).sum()) for line in axes.lines] == [0, 1]


class Mood(Enum):
    """What a robot is about."""

    SEARCHES = 1
    HAS_FOUND = 2


class Moody(SyncApp):
    """Has a state of an enum, and a result with more texts than are drawn."""

    mood: Mood = Mood.SEARCHES

    def step(self, neighbours: object) -> None:
        """Find in the end."""
        if self.k == 14:
            self.mood = Mood.HAS_FOUND

    def result(self) -> dict[str, object]:
        """Texts."""
        return {"mood": self.mood.name, "text": f"after {self.k}"}


def test_members_of_an_enum_are_steps_with_their_names() -> None:
    made = simulate(Moody, robots=2, iterations=20, progress=False).plot()
    assert len(made.axes) == 2
    assert [tick.get_text() for tick in made.axes[0].get_yticklabels()] == ["SEARCHES", "HAS_FOUND"]
    assert made.axes[0].lines[1].get_drawstyle() == "steps-post"
    assert list(made.axes[0].lines[1].get_ydata()) == [0.0] * 15 + [1.0] * 6


class Backwards(Moody):
    """Comes to the members of its enum in another order than the declared one."""

    mood: Mood = Mood.HAS_FOUND

    def step(self, neighbours: object) -> None:
        """Lose it again."""
        self.mood = Mood.SEARCHES


def test_members_of_an_enum_have_their_declared_order_whichever_comes_first() -> None:
    made = simulate(Backwards, robots=2, iterations=20, progress=False).plot()
    assert [tick.get_text() for tick in made.axes[0].get_yticklabels()] == ["SEARCHES", "HAS_FOUND"]
    assert list(made.axes[0].lines[1].get_ydata()) == [1.0] + [0.0] * 20


class ManyMarked(Marked):
    """Names an entry of its vector, and something that is not there."""

    plotted = ("p[1]", "speed", "count")


class Large(Marked):
    """Has more entries than a picture has rows."""

    w: Annotated[Vector, 9] = (0.0,) * 9
    plotted = ("w",)


class Matrices(Marked):
    """Has more entries than a picture has rows, with long names."""

    inverse_of_p: Annotated[Matrix, 4, 4] = ((0.0,) * 4,) * 4
    plotted = ("inverse_of_p",)


@pytest.mark.parametrize(
    ("app", "rows", "said"),
    [
        (ManyMarked, ["p[1]", "count"], "`plotted` names what cannot be drawn: speed"),
        (Large, [f"w[{i}]" for i in range(6)], "not shown, as 6 rows are the most: w[6], w[7], w[8] (ask for them by"),
        (
            Matrices,
            [f"inverse_of_p[{i // 4},{i % 4}]" for i in range(6)],
            "inverse_of_p[2,3], and 4 more (ask for them by name)",
        ),
    ],
)
def test_a_picture_says_what_it_leaves_out(app: type[SyncApp], rows: list[str], said: str) -> None:
    made = simulate(app, robots=2, iterations=5, progress=False).plot()
    assert [axes.get_ylabel() for axes in made.axes[::2]] == rows
    assert said in made.get_supxlabel().replace("\n", " ")
    made.canvas.draw()
    note = made._supxlabel.get_window_extent()  # type: ignore[attr-defined]
    assert note.x0 >= 0.0
    assert note.x1 <= made.bbox.width


def test_the_line_of_a_robot_that_others_went_on_without_has_a_gap_in_both_panels() -> None:
    run = simulate("consensus", robots=3, topology="full", seconds=10, faults=["off r2@1s,5s"], absent="drop",
                   drop_after=1.0, progress=False)  # fmt: skip
    for axes in run.plot().axes[:2]:
        away = [int(isnan(line.get_ydata()).sum()) for line in axes.lines]
        assert away[2] == 1, "r2 was away once"
        assert axes.get_xlabel() != "iteration" or away[:2] == [0, 0]


@pytest.mark.parametrize("kind", ["periodic", "off for less time than the others wait"])
def test_a_robot_that_was_away_is_marked_over_iterations(kind: str) -> None:
    app, away = (Steady, "5s") if kind == "periodic" else ("consensus", "4s")
    run = simulate(app, robots=3, topology="full", seconds=12, faults=[f"off r2@2s,{away}"], absent="drop",
                   progress=False)  # fmt: skip
    left, right = run.plot().axes[:2]
    for axes in (left, right):
        marks = [line for line in axes.lines if line.get_linestyle() == "None" and len(line.get_xdata())]
        own = [line.get_marker() for line in marks if line.get_color() == axes.lines[2].get_color()]
        assert own[-2:] == ["x", "o"]  # over time each also waits for the others at the start
    assert len([line for line in left.lines if line.get_linestyle() == "None"]) == 2
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["stops", "goes on"]


def test_a_lockstep_that_was_killed_is_marked_however_short_it_was_away() -> None:
    run = simulate("consensus", robots=4, iterations=60, faults=["kill r2.app@1s", "kill r2.app@1.55s"], progress=False)
    for axes in run.plot().axes[:2]:
        marks = [line for line in axes.lines if line.get_linestyle() == "None" and len(line.get_xdata())]
        assert [line.get_marker() for line in marks] == ["x", "o", "x", "o"]
        assert {line.get_color() for line in marks} == {axes.lines[2].get_color()}


class Ticks(EventApp):
    """Counts in halves, at times that differ."""

    x: float

    def start(self) -> None:
        """Begin."""
        self.robot.after(0.3, "tick")

    def on_timer(self, name: str) -> None:
        """Count."""
        self.x += 0.5
        self.robot.after(0.3 * self.x, "tick")


@pytest.mark.parametrize(("app", "style"), [(Ticks, "steps-post"), (Steady, "steps-post"), ("consensus", "default")])
def test_what_an_event_leaves_holds_until_the_next(app: type[EventApp] | str, style: str) -> None:
    run = simulate(app, robots=2, seconds=4, progress=False)
    left, right = run.plot().axes[:2]
    assert left.lines[0].get_drawstyle() == "default"
    assert right.lines[0].get_drawstyle() == style


def test_names_keep_clear_of_each_other() -> None:
    from laptop.plotting import style

    axes = figure.Figure(figsize=(4, 4)).add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    style.name_points(axes, [(f"r{i}", (0.5 + 0.03 * i, 0.5), "black") for i in range(4)], marks=[(0.5, 0.54)])
    boxes = [text.get_window_extent() for text in axes.texts]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    mark = axes.transData.transform((0.5, 0.54))
    assert not any(box.contains(*mark) for box in boxes)


def test_a_formation_has_its_misfit_and_the_nearest_two_and_true_paths(tmp_path: Path) -> None:
    run = simulate("formation", robots=3, seconds=4, devices=True, progress=False)
    place, distances = run.plot(kind="map").axes
    assert [line.get_label() for line in distances.lines] == ["nearest two", "robots touch", "from the formation"]
    assert "true path" in place.get_legend_handles_labels()[1]
