"""What authors of event-driven and periodic apps may write, and what the platform says when it is wrong."""

import enum
import math
import re
import sys
from collections.abc import Callable
from typing import Annotated, Any

import pytest

from services.apps.event_runner import EventRunner, version
from services.apps.runner import Runner
from swarm import EventApp, Matrix, PeriodicApp, SyncApp, channel, parameter
from swarm.app.overlays import Message
from swarm.app.robot import Robot
from swarm.core.asynchronous import HandlerCall, NeighbourState
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.messages import AppOutput

LINE = Graph.of_shape("line", ["r0", "r1", "r2"])


class Mood(enum.Enum):
    CALM = 0
    WILD = 1


class Inner(SyncApp):
    """A lockstep for a channel."""

    value: float
    _input: float = 0.0
    gain: float = parameter(0.5, low=0, high=1)

    def step(self, neighbours: list[Any]) -> None:
        self.value += self.gain


class Dancer(PeriodicApp):
    """One of each."""

    mood: Mood
    turns: int = 3
    table: Annotated[Matrix, 2, 2]
    _partner: object
    period = 0.5
    gain: float = parameter(0.5, low=0, high=1)
    fixed: int = parameter(1, live=False)
    inner = channel(Inner, gain=0.25)
    other = channel(Inner)

    def step(self, neighbours: list[Any]) -> None:
        self.turns = sum(n.turns for n in neighbours)

    def on_button(self, button: str) -> None:
        self._partner = button

    def on_neighbour(self, neighbour: Any) -> None:
        self._partner = (neighbour.name, neighbour.mood, neighbour.age)


def raises(*_: object) -> None:
    raise ValueError("I will not")


def make(kind: type[EventApp] = Dancer, **values: Any) -> Any:
    return kind(Robot("r1", LINE), values)


def runner(kind: type[EventApp] = Dancer, **handlers: Callable[..., object]) -> EventRunner:
    made = type(kind.__name__, (kind,), {**handlers, "__module__": __name__})
    return EventRunner(made(Robot("r1", LINE)), __file__)


def packed(mood: Mood = Mood.CALM, turns: int = 0) -> bytes:
    return Dancer.spec.schema.pack({"mood": mood, "turns": turns, "table": ((0.0, 0.0), (0.0, 0.0))})


# Declarations


def test_an_event_app_has_the_state_and_parameters_that_it_declares() -> None:
    assert Dancer.spec.schema.names == ("mood", "turns", "table")
    assert Dancer.spec.schema.size == 1 + 8 + 32
    assert set(Dancer.spec.parameters) == {"weights", "period", "gain", "fixed"}
    app = make()
    assert (app.mood, app.turns, app.table, app.period) == (Mood.CALM, 3, ((0.0, 0.0), (0.0, 0.0)), 0.5)
    assert make(period=2, mood="WILD").mood is Mood.WILD
    assert make(table=[1, 2, 3, 4]).table == ((1.0, 2.0), (3.0, 4.0))


def test_a_plain_value_is_a_parameters_default_in_a_derived_class() -> None:
    class Fast(Dancer):
        period = 0.02
        weights = "row"

    assert (make(Fast).period, make(Fast, period=1.0).period, make(Fast).weights) == (0.02, 1.0, "row")
    with pytest.raises(AppError, match=r"class Slow: period: default: expected a finite number from 0.01 to 3600 in s"):
        type("Slow", (Dancer,), {"period": 4000.0})
    with pytest.raises(AppError, match=r"class Odd: period: it is a parameter, expected parameter\(...\) or a value"):
        type("Odd", (Dancer,), {"period": [1.0]})


@pytest.mark.parametrize("name", ["neighbours", "age", "finish", "on_button", "step", "k", "robot"])
def test_names_of_the_platform_are_refused(name: str) -> None:
    with pytest.raises(AppError, match=f"class Bad: {name}: this name belongs to the platform"):
        type("Bad", (PeriodicApp,), {"__annotations__": {name: int}})


def test_an_app_that_shares_nothing_is_fine_and_one_that_shares_too_much_is_not() -> None:
    class Quiet(EventApp):
        """Nothing at all."""

    assert make(Quiet).spec.schema.size == 0
    big = type("Big", (EventApp,), {"__annotations__": {"x": Annotated[Matrix, 8, 8]}})
    with pytest.raises(AppError, match="the state of Big takes 512 bytes, a frame holds 440"):
        make(big)


def test_an_app_can_define_weights_of_its_own() -> None:
    class Own(SyncApp):
        value: float

        def neighbour_weights(self) -> dict[str, float]:
            return dict.fromkeys(self.robot.neighbours, 0.25)

        def step(self, neighbours: list[Any]) -> None: ...

    app = Own(Robot("r1", LINE))
    assert app.robot.weights == {"r0": 0.25, "r2": 0.25}
    assert app.robot.own_weight == 0.5
    for wrong in ({"r0": 0.5}, {"r0": 0.5, "r2": math.nan}):
        kind = type("Wrong", (Own,), {"neighbour_weights": lambda self, wrong=wrong: wrong})
        with pytest.raises(AppError, match="neighbour_weights: expected a finite number for each of r0, r2, got"):
            kind(Robot("r1", LINE))


@pytest.mark.parametrize(
    ("base", "body", "message"),
    [
        (
            EventApp,
            {"on_buton": raises},
            "class Bad: there is no handler on_buton, there are on_ann",
        ),
        (EventApp, {"step": raises}, "class Bad: an EventApp has no steps; a PeriodicApp has"),
        (PeriodicApp, {"measured": True}, "class Bad: measured: only a SyncApp is given a measurement for each step"),
    ],
)
def test_what_would_never_be_called_is_refused(base: type, body: dict[str, Any], message: str) -> None:
    with pytest.raises(AppError, match=message):
        type("Bad", (base,), body)


# Parameters while it runs


def test_changes_are_checked_and_all_or_none() -> None:
    check = Dancer.check_change
    assert check({"gain": 1}) == {"gain": 1.0}
    for values, message in (
        ({"gain": 2.0}, "gain: expected a finite number from 0 to 1, got 2.0"),
        ({"gain": 0.1, "fixed": 2}, "fixed: cannot be changed while the app runs: it is declared without live=True"),
        ({"turns": 2}, "unknown parameter 'turns'; Dancer has weights, period, gain, fixed"),
    ):
        with pytest.raises(AppError, match=re.escape(message)):
            check(values)
    with pytest.raises(AppError, match="gain: cannot be changed while the app runs"):
        Inner.check_change({"gain": 0.1})


def test_a_change_holds_from_the_next_handler_on() -> None:
    each = runner()
    each.call(HandlerCall("start"), 0, [])
    assert each.change({"gain": 0.75, "period": 0.1}) == ["gain", "period"]
    assert each.app.gain == 0.5  # type: ignore[attr-defined]
    each.call(HandlerCall("on_parameter", ("gain",)), 0, [])
    assert (each.app.gain, each.period) == (0.75, 0.1)  # type: ignore[attr-defined]


# Channels


def test_a_channel_is_another_instance_with_parameters_of_its_own() -> None:
    app = make(inner_value=2.0, other_gain=0.75)
    assert (app.inner.value, app.inner.app.gain, app.inner.k) == (2.0, 0.25, 0)
    assert (app.other.value, app.other.app.gain) == (0.0, 0.75)
    app.inner.value = 3
    assert (app.inner.value, app.inner.app.value) == (3.0, 3.0)
    app.inner.feed(_input=0.5)
    assert app.inner.inputs == {"_input": 0.5}
    app.inner.begin(app.inner.app.change)
    app.inner.take(7, {"value": 4.0})
    assert (app.inner.k, app.inner.value) == (7, 4.0)
    with pytest.raises(AttributeError, match=r"channel inner has begun: its first values are set in start\(\)"):
        app.inner.value = 1.0


class Adding(SyncApp):
    """A lockstep that adds each input once."""

    value: float
    _input: list = []  # noqa: RUF012 - a field of an app, which each instance gets a copy of

    def start(self) -> None:
        self._input = []

    def step(self, neighbours: list[Any]) -> None:
        while self._input:
            self.value += self._input.pop()


class Feeding(EventApp):
    inner = channel(Adding)


def test_an_input_of_a_channel_counts_once_whatever_epochs_begin() -> None:
    view = make(Feeding).inner
    runner = Runner(view.app, __file__, inputs=view.inputs)
    view.feed(_input=[0.25])  # before the lockstep's own start
    history = [runner.start(None)]
    view.begin(view.app.change)

    def step() -> float:
        history.append(runner.step(len(history) - 1, history[-1][0], {}, None))
        return view.app.value  # type: ignore[no-any-return]

    def renew(k: int) -> None:
        """An epoch begins, at an iteration that this robot has done."""
        del history[k + 1 :]
        runner.renew(k, k, *history[k], LINE)

    assert [step(), step()] == [0.25, 0.25]
    view.feed(_input=[1.0])
    renew(2)  # between the input and the step that takes it
    assert [step(), step()] == [1.25, 1.25]
    renew(2)  # the step that took it is done again
    assert [step(), step()] == [1.25, 1.25]
    renew(3)  # the input is in the state
    assert [step(), step()] == [1.25, 1.25]
    view.feed(_input=[2.0])
    assert step() == 3.25
    view.feed(_input=[4.0])
    renew(5)  # of two inputs the newest counts
    assert [step(), step()] == [5.25, 5.25]


def test_an_input_from_the_start_of_an_app_counts_once_where_the_lockstep_uses_it_in_its_own_start() -> None:
    class Eager(Adding):
        def start(self) -> None:
            self.value += sum(self._input)

    class EagerlyFed(EventApp):
        inner = channel(Eager)

    view = make(EagerlyFed).inner
    runner = Runner(view.app, __file__, inputs=view.inputs)
    view.feed(_input=[0.25])
    own, _ = runner.start(None)
    runner.step(0, own, {}, None)
    assert view.app.value == 0.25


def test_an_input_of_a_channel_is_what_it_was_when_it_was_fed() -> None:
    view = make(Feeding).inner
    runner = Runner(view.app, __file__, inputs=view.inputs)
    own, private = runner.start(None)
    fed = [0.25]
    view.feed(_input=fed)
    fed.append(1.0)
    runner.step(0, own, {}, None)
    fed.append(2.0)
    runner.renew(0, 0, own, private, LINE)
    runner.step(0, own, {}, None)
    assert view.app.value == 0.25


def test_an_input_of_a_channel_counts_once_where_an_epoch_begins_at_another_iteration_than_that_of_the_state() -> None:
    view = make(Feeding).inner
    runner = Runner(view.app, __file__, inputs=view.inputs)
    state = runner.start(None)

    def steps(first: int, last: int) -> tuple[bytes, bytes]:
        now = state
        for k in range(first, last):
            now = runner.step(k, now[0], {}, None)
        return now

    early = state = steps(0, 4)
    view.feed(_input=[0.25])
    state = steps(4, 6)
    runner.renew(9, 4, *early, LINE)  # an epoch that another one follows before it begins here
    state = runner.renew(2, 6, *state, LINE)  # the input is in the state, whatever its iteration is called now
    state = steps(2, 4)
    assert view.app.value == 0.25
    state = runner.renew(3, 3, *state, LINE)  # an iteration of the new epoch, before that of the input by number
    steps(3, 4)
    assert view.app.value == 0.25
    view.feed(_input=[1.0])
    steps(4, 6)
    runner.renew(9, 4, *state, LINE)  # the step that took it is done again, under a greater number
    steps(9, 10)
    assert view.app.value == 1.25


@pytest.mark.parametrize("entered", [False, True])
def test_an_input_of_a_channel_counts_once_where_two_epochs_follow_each_other_without_a_step(entered: bool) -> None:
    view = make(Feeding).inner
    runner = Runner(view.app, __file__, inputs=view.inputs)
    state = runner.start(None)
    view.feed(_input=[1.0])
    runner.step(0, state[0], {}, None)  # void: an epoch begins with the state before it, under a greater number
    state = runner.renew(50, 0, *state, LINE)
    if entered:
        runner.entered(50)
    state = runner.renew(50, 50 if entered else 0, *state, LINE)
    runner.entered(50)
    taken, *_ = runner.step(50, state[0], {}, None), runner.step(51, state[0], {}, None)
    assert taken == (runner.schema.pack({"value": 1.0}), taken[1])
    # In the state that an epoch begins with, whose number is smaller.
    runner.step(51, taken[0], {}, None)
    state = runner.renew(10, 51, *taken, LINE)
    runner.entered(10)
    state = runner.renew(10, 10, *state, LINE)
    runner.step(10, state[0], {}, None)
    assert view.app.value == 1.0


def test_wrong_use_of_a_channel_is_said() -> None:
    app = make()
    with pytest.raises(AttributeError, match="channel inner has value, but no 'valeu'"):
        app.inner.valeu = 1.0
    with pytest.raises(AttributeError, match="channel inner has k, value, but no 'valeu'"):
        _ = app.inner.valeu
    with pytest.raises(AttributeError, match="channel inner: 'value' is no input; Inner has _input"):
        app.inner.feed(value=1.0)
    with pytest.raises(AppError, match="channel inner: gain: expected a finite number from 0 to 1, got 3"):
        make(inner_gain=3.0)
    with pytest.raises(AppError, match=r"unknown parameter 'inner_nothing'; .*, inner_gain, .*inner_value"):
        make(inner_nothing=3.0)
    with pytest.raises(AppError, match="expected a class derived from SyncApp"):
        channel(Dancer)  # type: ignore[arg-type]


# Handlers


def test_which_handlers_an_app_has() -> None:
    assert runner().handled == {"on_button", "on_neighbour"}


def test_a_handler_sees_the_neighbours_with_ages() -> None:
    each = runner()
    known = [NeighbourState("r0", packed(Mood.WILD, 5), 0.25), NeighbourState("r2", packed(turns=2), 0.5)]
    own = each.call(HandlerCall("step"), 0, known)
    assert own == packed(turns=7)
    assert [(n.name, n.mood, n.turns, n.age) for n in each.app.neighbours] == [
        ("r0", Mood.WILD, 5, 0.25), ("r2", Mood.CALM, 2, 0.5),
    ]  # fmt: skip
    each.call(HandlerCall("on_neighbour", ("r0",)), 1, known)
    assert each.app._partner == ("r0", Mood.WILD, 0.25)  # type: ignore[attr-defined]


def test_a_state_that_no_program_of_ours_sends_is_left_out() -> None:
    each = runner()
    broken = b"\x09" + packed()[1:]
    each.call(HandlerCall("step"), 0, [NeighbourState("r0", broken, 0.0)])
    assert each.app.neighbours == ()
    assert each.unreadable == 1
    each.call(HandlerCall("on_neighbour", ("r0",)), 1, [NeighbourState("r0", broken, 0.0)])


@pytest.mark.parametrize(
    ("handler", "function", "message"),
    [
        ("step", raises, r"Dancer on r1, step 4: .*test_event_app_api.py, line \d+: ValueError: I will not"),
        ("on_button", raises, r"Dancer on r1, on_button\(\) at k = 4: .*line \d+: ValueError: I will not"),
        ("step", lambda *_: sys.exit("bye"), r"step 4: .*line \d+: SystemExit: bye"),
        ("step", lambda *_: 5, r"step 4: .*, from line \d+ on: it returned 5; a handler assigns to the state instead"),
        (
            "step",
            lambda self, _: setattr(self, "turns", 1.5),
            r"step 4: .*from line \d+ on: turns: expected an integer of 64 bits, got 1.5",
        ),
        (
            "step",
            lambda self, _: setattr(self, "mood", "CALMER"),
            r"step 4: .*from line \d+ on: mood: expected CALM or WILD, got 'CALMER'",
        ),
        (
            "step",
            lambda self, _: setattr(self, "table", ((0.0, math.nan), (0.0, 0.0))),
            r"step 4: .*from line \d+ on: table: nan is not a finite number",
        ),
        (
            "step",
            lambda self, _: setattr(self, "table", (1.0,)),
            r"step 4: .*from line \d+ on: table: expected 2 rows of 2 numbers",
        ),
        (
            "step",
            lambda self, _: setattr(self, "gain", 1.0),
            "AttributeError: Dancer.gain is a parameter, a step cannot",
        ),
        ("step", lambda self, _: self.robot.after(-1.0, "x"), r"step 4: .*SyncApp has no timers"),
    ],
)
def test_bad_behaviour_is_named_with_robot_and_step(
    handler: str, function: Callable[..., object], message: str
) -> None:
    each = runner(**{handler: function})
    arguments = {"on_button": ("a",)}.get(handler, ())
    with pytest.raises(AppError, match=message):
        each.call(HandlerCall(handler, arguments), 4, [])


def test_an_event_app_can_finish_itself_with_a_reason() -> None:
    each = runner(on_button=lambda self, _: self.finish("enough"))
    assert not each.finished
    each.call(HandlerCall("on_button", ("a",)), 0, [])
    assert each.finished
    assert each.app.finished == "enough"


def test_messages_and_timers_come_as_they_are() -> None:
    found: list[object] = []
    each = runner(
        on_message=lambda self, message: found.append(message),
        on_timer=lambda self, name: found.append(name),
        on_answer=lambda self, ticket, outcome: found.append((ticket, outcome)),
    )
    message = Message("r2", b"hi", flooded=True)
    for call in (
        HandlerCall("on_message", (message,)),
        HandlerCall("on_timer", ("t",)),
        HandlerCall("on_answer", ("x-1", "done")),
    ):
        each.call(call, 0, [])
    assert found == [message, "t", ("x-1", "done")]


def test_state_and_result_are_plain() -> None:
    each = runner()
    each.call(HandlerCall("start"), 0, [])
    assert each.state() == each.result() == {"mood": "CALM", "turns": 3, "table": (0.0, 0.0, 0.0, 0.0)}


def test_the_version_is_over_source_state_and_swarm() -> None:
    app = make()
    assert version(app, b"a") == version(make(gain=0.1), b"a") != version(app, b"b")
    other = Dancer(Robot("r1", Graph.of_shape("line", ["r0", "r1", "r3"])))
    assert version(app, b"a") != version(other, b"a")


def test_what_is_published_is_checked() -> None:
    app = make()
    with pytest.raises(AppError, match=r"robot\.publish needs a bus"):
        app.robot.publish("x", 1)
    published: list[tuple[str, Any]] = []

    class Bus:
        def publish(self, key: str, message: object) -> None:
            published.append((key, message))

    app.robot.bus, app.robot.app, app.robot.time = Bus(), "dancer", lambda: 2.5
    app.robot.publish("place", {"x": 1, "path": [1, 2.5]})
    app.robot.publish("done", True)
    assert published == [
        ("swarm/r1/app/dancer/out/place", AppOutput(2.5, {"x": 1, "path": (1.0, 2.5)})),
        ("swarm/r1/app/dancer/out/done", AppOutput(2.5, {"value": True})),
    ]
    for wrong in (math.nan, None, {"x": object()}, [math.inf]):
        with pytest.raises(AppError, match=r"robot\.publish\('x'\): expected a finite number, bool, text or vector"):
            app.robot.publish("x", wrong)
    for topic in ("a b", "*", "", "a//b"):
        with pytest.raises(AppError, match=r"robot\.publish\(.*\): expected letters, digits and _ \. : -, with /"):
            app.robot.publish(topic, 1)


def test_what_is_recorded_goes_to_the_recording_and_else_nowhere() -> None:
    app = make()
    app.robot.record("x", 1.0)
    found: list[tuple[str, float, object]] = []
    app.robot.recording, app.robot.time = lambda *row: found.append(row), lambda: 2.5
    app.robot.record("x", 1.0)
    assert found == [("x", 2.5, 1.0)]
    for name in ("a b", "*", "", "a/b"):
        with pytest.raises(AppError, match=r"robot\.record\(.*\): expected letters, digits and _ \. : -"):
            app.robot.record(name, 1.0)
