"""Robots with clocks of their own under virtual time: nothing but the mesh clock brings them together."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.scenario.options import parse
from sim.virtual.events import EventQueue, LocalTime
from sim.virtual.run import run_virtually
from swarm.errors import ConfigError
from swarm.recording.run import Run

SIX = ("consensus", "--robots", "6", "--iterations", "60")
SKEWED = ("--clock-skew", "30ppm", "--jitter", "10ms")


@given(st.floats(0.0, 1e4), st.floats(-1e-4, 1e-4), st.lists(st.floats(0.0, 100.0), min_size=1, max_size=20))
def test_a_call_is_made_when_the_own_clock_shows_its_time(offset, rate, delays):
    world, shown = EventQueue(), []
    clock = LocalTime(world, offset, rate)
    for delay in delays:
        at = clock.now + delay
        clock.at(at, lambda at=at: shown.append((at, clock.now)))
    world.run()
    assert len(shown) == len(delays)
    for at, now in shown:
        assert at <= now <= at + 1e-9
    assert world.now == pytest.approx(max(delays), rel=2e-4, abs=1e-9)


def test_a_lockstep_needs_no_common_clock(tmp_path):
    _, plain = run_virtually(*SIX, rows=True)
    report, outcome = run_virtually(*SIX, *SKEWED, "--record", str(tmp_path), rows=True)
    assert report["problems"] == []
    assert report["iteration_s_median"] == pytest.approx(0.038, abs=0.002)
    assert {n: path.rows for n, path in outcome.trajectories.items()} == {
        n: path.rows for n, path in plain.trajectories.items()
    }
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == [f"r{i}.consensus.mcap" for i in range(6)]


def test_leds_blink_together_by_the_mesh_clock_alone(tmp_path):
    """Zeros up to an hour apart, rates up to 30 ppm, no NTP."""
    arguments = ("led_sync", "--robots", "6", *SKEWED, "--seconds", "15", "--record", str(tmp_path))
    report, _ = run_virtually(*arguments)
    assert report["problems"] == []
    assert report["scene"]["apart_neighbours_p95_ms"] <= 10
    assert report["scene"]["apart_all_p95_ms"] <= 20
    assert report["scene"]["synchronous_after_s"] <= 30
    run = Run(tmp_path)
    assert run.damage == []


def test_only_virtual_time_has_other_clocks():
    with pytest.raises(ConfigError, match="processes of one machine have one clock"):
        parse([*SIX, "--clock-skew", "20ppm"])
    with pytest.raises(SystemExit):
        parse([*SIX, "--virtual", "--clock-skew", "200ppm"])
