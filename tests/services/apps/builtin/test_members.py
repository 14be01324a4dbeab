"""A robot leaves in mid-run: the algorithms end where the members that are left belong."""

import math

import pytest
from conftest import thinned

from services.apps import loader
from services.apps.builtin.localization.leastsquares import refine
from sim.rehearsal.scene import TARGET, rehearsal_config
from sim.rehearsal.sync import SyncRehearsal
from sim.scenario.options import DELAY
from sim.scenario.scenario import PLACES
from swarm.messages import Measurement

ALL = tuple(f"r{i}" for i in range(6))
LEFT = ("r0", "r1", "r3", "r4", "r5")
STARTS = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0)


def biased(name: str, k: int) -> Measurement:
    """Each robot's range is wrong by an amount of its own, so that it matters who is there."""
    index = int(name[1:])
    return Measurement(0.0, k, math.dist(PLACES[index], TARGET) + 0.02 * (index - 2), *PLACES[index])


def run(app: str, algorithm: str, before: int, after: int, **parameters: object) -> SyncRehearsal:
    """`before` iterations on a loop, then r2 is gone and the others are in a line."""
    found = loader.load(app)
    config = rehearsal_config(found, 6, "loop", {"algorithm": algorithm, **parameters})  # type: ignore[arg-type]
    swarm = SyncRehearsal(found, config, measure=biased, mesh=DELAY)
    swarm.run(before)
    swarm.drop("r2")
    swarm.run(after)
    return swarm


@pytest.mark.parametrize("algorithm", ["metropolis", "second_order", "chebyshev"])
def test_the_mean_of_what_the_members_have_stays(algorithm: str) -> None:
    swarm = run("consensus", algorithm, 3, 0)
    mean = math.fsum(float(swarm.result(name)["value"]) for name in LEFT) / 5  # type: ignore[arg-type]
    swarm.run(150)
    for name in LEFT:
        assert swarm.result(name)["value"] == pytest.approx(mean, abs=1e-6)


def test_flood_drops_the_value_of_who_is_gone() -> None:
    swarm = run("consensus", "flood", 2, 4)
    left = [x for i, x in enumerate(STARTS) if i != 2]
    for name in LEFT:
        assert swarm.result(name) == {"value": math.fsum(left) / 5, "known": 5}


@pytest.mark.parametrize("algorithm", ["nids", "flood"])
def test_least_squares_of_the_members(algorithm: str) -> None:
    swarm = run("localization", algorithm, 30, 400)
    seen = [(m.distance, m.x, m.y) for m in (biased(name, 0) for name in LEFT)]
    best = refine(seen, TARGET)
    for name in LEFT:
        result = swarm.result(name)
        assert (result["x"], result["y"]) == pytest.approx(best, abs=1e-3)


@pytest.mark.parametrize(("algorithm", "iterations"), thinned([("info", 300), ("diging", 900), ("thesis", 900)]))
def test_as_if_the_member_had_never_been_there(algorithm: str, iterations: int) -> None:
    """The same end as of a swarm of five that begins without it."""
    parameters = {"step_size": 0.02} if algorithm in ("diging", "thesis") else {}
    swarm = run("localization", algorithm, 30, iterations, **parameters)
    anew = run("localization", algorithm, 0, iterations, **parameters)
    for name in LEFT:
        for axis in ("x", "y"):
            assert swarm.result(name)[axis] == pytest.approx(anew.result(name)[axis], abs=1e-3)
        assert swarm.result(name)["var_x"] == pytest.approx(anew.result(name)["var_x"], rel=0.02)


@pytest.mark.parametrize("algorithm", ["nids", "diging", "thesis"])
def test_a_place_that_stands_still_has_converged(algorithm: str) -> None:
    parameters = {"step_size": 0.02} if algorithm in ("diging", "thesis") else {}
    swarm = run("localization", algorithm, 3, 1, **parameters)
    assert not any(swarm.units[name].host.runner.content() for name in LEFT)
    swarm.run(500)
    assert all(swarm.units[name].host.runner.content() for name in LEFT)
