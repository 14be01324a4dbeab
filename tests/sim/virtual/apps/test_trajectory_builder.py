"""What a run under virtual time keeps of each robot's iterations, however many there are."""

import random
from types import SimpleNamespace

import pytest

from services.apps.host.observer import StepRecord
from sim.virtual.apps import trajectory_builder as module
from sim.virtual.apps.trajectory_builder import TrajectoryBuilder
from swarm.core.percentile import percentile
from swarm.recording.trajectory import iteration_times, median

FIELD = SimpleNamespace(name="value", columns=("value",), shape=())
SOURCE = SimpleNamespace(runner=SimpleNamespace(schema=SimpleNamespace(fields=(FIELD,)), shapes={}))


def written(count, *, keep):
    """A builder of `count` iterations that take 0.1 s on average."""
    numbers = random.Random(1)
    builder, t = TrajectoryBuilder(keep=keep), 0.0
    for k in range(count):
        t += numbers.uniform(0.05, 0.15)
        builder.write(SOURCE, StepRecord(k, t, {"value": float(k)}, {}))
    return builder


def test_times_of_a_long_run_are_thinned_out_and_measure_the_same(monkeypatch):
    monkeypatch.setattr(module, "MOST_TIMES", 1000)
    long = written(50_000, keep=False)
    assert len(long._times) <= 1000
    found, whole = long.trajectory(), written(50_000, keep=True).trajectory()
    assert found.last == whole.last == 49_999
    assert found.newest == whole.newest
    assert found.first_reached() == whole.first_reached()
    assert found.times.items() <= whole.times.items()
    some, all_ = iteration_times({"r0": found}), iteration_times({"r0": whole})
    assert len(some) > 100
    assert median(some) == pytest.approx(median(all_), rel=0.03)
    assert percentile(some, 95) == pytest.approx(percentile(all_, 95), rel=0.05)


def test_a_short_run_keeps_every_time():
    found, whole = written(500, keep=False).trajectory(), written(500, keep=True).trajectory()
    assert found.times == whole.times


def test_a_run_that_goes_back_forgets_the_iterations_that_are_done_again(monkeypatch):
    monkeypatch.setattr(module, "MOST_TIMES", 100)
    builder = written(1000, keep=False)
    builder.go_back(600)
    assert max(builder._ks) < 600
    builder.write(SOURCE, StepRecord(600, 500.0, {"value": 0.0}, {}))
    found = builder.trajectory()
    assert (found.last, found.newest) == (600, 500.0)
