"""`--mesh delay` computes what meshes compute, in the same time of the links; and says what it cannot do."""

import pytest

from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.errors import ConfigError, LocalError

ARGUMENTS = ("consensus", "--robots", "12", "--topology", "random:3", "--iterations", "60")


@pytest.mark.parametrize(
    "links",
    [
        (),
        pytest.param(("--jitter", "10ms"), marks=pytest.mark.slow),
        pytest.param(("--bandwidth", "5kB"), marks=pytest.mark.slow),
        ("--cut", "r1-r2@0.3s,1s", "--topology", "line"),
    ],
)
def test_states_are_bit_equal_and_times_alike(links):
    with_mesh, first = run_virtually(*ARGUMENTS, *links, rows=True)
    delays, second = run_virtually(*ARGUMENTS, *links, "--mesh", "delay", rows=True)
    for name, path in first.trajectories.items():
        assert second.trajectories[name].rows == path.rows
    assert delays["iteration_s_median"] == pytest.approx(with_mesh["iteration_s_median"], rel=0.06)
    # The meshes also tell each other their links at the start, which takes time where links carry 5 kB a second.
    assert delays["seconds"] == pytest.approx(with_mesh["seconds"], rel=0.15)
    assert delays["messages"] == pytest.approx(with_mesh["messages"], rel=0.1)


def test_what_comes_to_a_robot_in_one_moment_is_one_call_and_after_a_cut_each_message_is_one():
    together, apart = (_calls(*more) for more in ((), ("--cut", "r1-r2@0.3s,0.1s")))
    assert together < 5.0 < apart  # with 2 links a robot


def _calls(*more: str) -> float:
    """Of the event queue, for each iteration of a robot."""
    options = parse(["consensus", "--virtual", "--robots", "30", "--topology", "loop", "--iterations", "100",
                     "--mesh", "delay", *more])  # fmt: skip
    run = VirtualRun(options, build(options, PLACE))
    run.go()
    return run.world.time.done / 3000


def test_periodic_apps_and_devices_run_on_delays():
    report, _ = run_virtually("examples/follow_leds.py", "--robots", "4", "--iterations", "10", "--mesh", "delay")
    assert report["iterations"] == 10
    assert report["problems"] == []


def test_what_needs_a_mesh_is_refused():
    with pytest.raises(LocalError, match="neighbours alone"):
        run_virtually("flooding_demo", "--robots", "3", "--press", "r0.A@1s", "--seconds", "3", "--mesh", "delay")
    with pytest.raises(ConfigError, match="automatic"):
        run_virtually("consensus", "--topology", "auto", "--mesh", "delay")


def test_a_large_swarm_has_a_short_table(capsys):
    from sim.report import summary
    from sim.report_table import MOST_ROWS, table

    arguments = ("consensus", "--robots", "60", "--topology", "loop", "--iterations", "3", "--mesh", "delay")
    report, outcome = run_virtually(*arguments)
    text = table(summary(outcome), outcome)
    assert "and 10 robots more" in text
    assert len(report["result"]) == 60
    assert text.count("value=") == MOST_ROWS
