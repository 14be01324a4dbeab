"""The controllers behind their one interface: how each stands, and how each follows a moving place."""

import math

import pytest
from balancer_rig import CONFIGURED, OTHER, PLANTS, Rig, scaled, upright
from conftest import examples, thinned
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control import lqr
from services.balancer.core.control.body import body_model
from services.balancer.core.control.choice import REGULATORS
from services.balancer.core.control.pololu import POLOLU, Pololu
from services.balancer.core.control.regulator import DUTY_LIMIT, STANDSTILL, Demand, Deviation
from services.balancer.core.parameters import BalancerParameter, BalancerParameters, around
from swarm.config.sections import CONTROLLERS
from swarm.config.types import Body
from swarm.errors import LocalError


def test_every_controller_of_the_config_is_there() -> None:
    assert set(CONTROLLERS) == set(REGULATORS)


@pytest.mark.costly
@pytest.mark.parametrize("name", thinned(PLANTS))
def test_pololus_constants_stand_on_both_bodies_and_a_fifth_off(name: str) -> None:
    rig = upright(plant=PLANTS[name], seed=len(name), controller="pololu").run(examples(30))
    assert rig.balancer.mode == "balancing"
    assert rig.worst_tilt < math.radians(10)
    assert math.hypot(rig.body.x, rig.body.y) < 0.2


@pytest.mark.costly
@pytest.mark.parametrize("name", thinned(name for name in PLANTS if name.startswith("configured")))
def test_the_thesis_constants_stand_on_our_body(name: str) -> None:
    rig = upright(plant=PLANTS[name], seed=len(name), controller="thesis").run(examples(30))
    assert rig.balancer.mode == "balancing"
    assert rig.worst_tilt < math.radians(10)


@pytest.mark.parametrize("controller", ["lqr", "pololu", "thesis"])
def test_each_bears_a_push_and_a_stall(controller: str) -> None:
    rig = upright(controller=controller).run(3)
    rig.body.push(0.05)
    rig.run(5)
    rig.lateness = lambda tick, at=rig.tick: 0.050 if tick == at else 0.0
    rig.run(5)
    assert rig.balancer.mode == "balancing"
    assert abs(rig.body.x) < 0.2


@pytest.mark.parametrize("side", [1, -1])
def test_pololu_stands_up_too(side: int) -> None:
    rig = Rig(tilt=side * math.radians(110), held=False, controller="pololu").run(15)
    assert rig.balancer.mode == "balancing"


@pytest.mark.parametrize("payload", thinned([None, 0.03, 0.12]))
@pytest.mark.parametrize("board", ["zero2w", "pi4"])
def test_each_board_and_payload_has_gains_that_hold_it(board: str, payload: float | None) -> None:
    body = body_model(board, Body(payload=payload))
    rig = upright(plant=body, believed=body).run(20)
    assert rig.balancer.mode == "balancing"
    assert rig.worst_tilt < math.radians(8)


@pytest.mark.costly
@pytest.mark.parametrize("name", thinned(["mass", "lever", "inertia", "stall_torque", "free_speed"]))
@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_pi_4_stands_and_gets_up_with_each_parameter_a_fifth_off(name: str, factor: float) -> None:
    body = body_model("pi4", Body())
    rig = Rig(scaled(body, name, factor), believed=body, tilt=math.radians(-110), held=False).run(15)
    assert rig.balancer.mode == "balancing"
    rig.worst_tilt = 0.0
    assert rig.run(examples(20)).worst_tilt < math.radians(8)


@pytest.mark.parametrize("trim", [0.19, -0.15])
@pytest.mark.parametrize("controller", ["lqr", "pololu"])
def test_trim_is_the_robots_own(controller: str, trim: float) -> None:
    rig = upright(trim=trim, controller=controller).run(20)
    assert rig.balancer.mode == "balancing"
    assert abs(rig.body.x) < 0.1


def test_pololu_is_its_formula() -> None:
    """One tick by hand: a robot that falls forward at 10 deg/s, 100 counts off on both sides."""
    regulator = Pololu(CONFIGURED, POLOLU)
    per_radian = CONFIGURED.counts_per_turn / math.tau
    regulator.reset(0.1, 0.0)
    way = 100 / per_radian * CONFIGURED.wheel_radius
    rate = math.radians(10)
    duty = regulator.duty(Deviation(way, 0.0, 0.0, rate, 0.01), STANDSTILL)
    angle = rate * 0.01 * 0.999
    rising = 10 * 140 + 1e3 * math.degrees(angle)
    distance = 2 * (100 - angle * per_radian)
    expected = 40 + (11 * rising + 73 * distance + 3300 * distance) / 100 / 110.25
    assert duty == pytest.approx(min(300.0, expected) / 400)


def test_pololu_counts_a_way_alike_in_one_tick_and_in_two_parts_of_it() -> None:
    duties = []
    for parts in ([(0.01, 0.002)], [(0.004, 0.001), (0.006, 0.002)]):
        regulator = Pololu(CONFIGURED, POLOLU)
        regulator.tune({**{name: each.value for name, each in regulator.parameters.items()}, "distance_response": 0.0})
        duties.append([regulator.duty(Deviation(way, 0.0, 0.0, 0.0, dt), STANDSTILL) for dt, way in parts][-1])
    assert duties[0] == pytest.approx(duties[1], rel=1e-9)


finite = st.floats(-100, 100)


@pytest.mark.parametrize("name", REGULATORS)
@given(states=st.lists(st.tuples(finite, finite, finite, finite, st.floats(0, 0.3)), min_size=1, max_size=20))
def test_any_deviation_gives_a_duty_within_the_limit(name: str, states) -> None:
    regulator = REGULATORS[name](CONFIGURED)
    regulator.reset(0.75, 0.4)
    for state in states:
        assert abs(regulator.duty(Deviation(*state), Demand(0.5, -0.5))) <= DUTY_LIMIT


@pytest.mark.parametrize("body", [CONFIGURED, OTHER], ids=["configured", "other"])
def test_feed_forward_holds_speed_and_acceleration_in_the_model(body) -> None:
    a, b = lqr.linear_model(body)
    by_speed, lean, by_acceleration = lqr.feed_forward(body)
    state = (0.0, 0.3, lean * 0.4, 0.0)
    duty = by_speed * 0.3 + by_acceleration * 0.4
    derivative = [sum(x * y for x, y in zip(row, state, strict=True)) + b[i][0] * duty for i, row in enumerate(a)]
    assert derivative == pytest.approx([0.3, 0.4, 0.0, 0.0], abs=1e-12)


def test_parameters_change_all_or_none() -> None:
    parameters = BalancerParameters({"a": BalancerParameter(1.0, 0.5, 2.0), "b": around(-3.0)})
    parameters.change({"a": 2.0, "b": -9.0})
    assert parameters.values == {"a": 2.0, "b": -9.0}
    for wrong, message in (
        ({"a": 1.0, "c": 1.0}, r"'c': unknown, there are a, b"),
        ({"a": 1.0, "b": -10.0}, r"parameter b: expected -9 to -1, got -10"),
        ({"a": math.nan}, r"parameter a: expected 0.5 to 2, got nan"),
    ):
        with pytest.raises(LocalError, match=message):
            parameters.change(wrong)
    assert parameters.values == {"a": 2.0, "b": -9.0}
