"""`--mesh delay` computes what meshes compute, in the same time of the links; and says what it cannot do."""

import pytest

from services.apps.loader import of_class
from sim.scenario.options import DELAY, FROM_START, SETTLED, parse
from sim.scenario.scenario import build
from sim.virtual.mesh_choice import mesh_of
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.errors import ConfigError, LocalError
from swarm.recording.run import Run

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


@pytest.mark.parametrize(
    ("words", "mesh"),
    [
        ("consensus --robots 201", DELAY),
        ("consensus --robots 200", SETTLED),
        ("consensus --robots 50", FROM_START),
        ("consensus --robots 201 --mesh settled", SETTLED),
        ("consensus --robots 201 --cut r0-r1@1s,1s", SETTLED),
        ("consensus --robots 201 --jitter 1ms", SETTLED),
        ("consensus --robots 201 --view", SETTLED),
        ("consensus flooding_demo --robots 201", SETTLED),
        ("examples/roll_call.py --robots 201", SETTLED),
        ("examples/follow_leds.py --robots 201", SETTLED),
    ],
)
def test_a_large_swarm_whose_app_only_shares_its_state_has_delays(words, mesh):
    options = parse(["--virtual", "--topology", "loop", *words.split()])
    assert mesh_of(options, build(options, PLACE)) == mesh


def test_links_are_told_and_cut_ones_are_down(tmp_path):
    run_virtually("consensus", "--robots", "3", "--topology", "line", "--iterations", "60", "--mesh", "delay",
                  "--cut", "r0-r1@0.5s,1s", "--record", str(tmp_path))  # fmt: skip
    told = [
        {link["peer"]: link["state"] for link in sample.message["links"]}
        for sample in Run(tmp_path).samples("swarm/r1/mesh/links")
    ]
    assert told[:2] == [{"r0": "up", "r2": "up"}, {"r0": "down", "r2": "up"}]
    assert told[-1] == {"r0": "up", "r2": "up"}


def test_a_large_swarm_has_a_short_table(capsys):
    from sim.report import summary
    from sim.report_table import MOST_ROWS, table

    arguments = ("consensus", "--robots", "60", "--topology", "loop", "--iterations", "3", "--mesh", "delay")
    report, outcome = run_virtually(*arguments)
    text = table(summary(outcome), outcome)
    assert "and 10 robots more" in text
    assert len(report["result"]) == 60
    assert text.count("value=") == MOST_ROWS


def test_an_app_whose_text_nobody_has_kept_may_need_a_mesh():
    """As a class that was typed at a prompt."""
    typed: dict[str, type] = {}
    method = "def step(self, n): self.robot.flood(b'')"
    exec(f"from swarm import SyncApp\nclass Typed(SyncApp):\n    value: float\n    {method}\n", typed)
    app = of_class(typed["Typed"])
    options = parse(["--virtual", "--topology", "loop", "typed", "--robots", "201"])
    assert mesh_of(options, build(options, PLACE, app)) == SETTLED
