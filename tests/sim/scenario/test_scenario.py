from dataclasses import replace

import pytest

from sim.scenario import options, scenario
from swarm.config import parse
from swarm.config.dump import dump
from swarm.errors import BusError, ConfigError, LocalError, RecordingError


def build(tmp_path, *arguments):
    return scenario.build(options.parse(list(arguments)), tmp_path)


def test_the_defaults_are_the_thesis_values(tmp_path):
    three = build(tmp_path, "consensus")
    assert [three.parameters[name]["value"] for name in ("r0", "r1", "r2")] == [0.5, 3.0, 5.0]
    six = build(tmp_path, "consensus", "--robots", "6", "--topology", "thesis-d")
    assert [parameters["value"] for parameters in six.parameters.values()] == [0.5, 1, 2, 3, 4, 5]
    assert len(six.config.edges) == 9
    assert six.config.simulation.target == (0.5, 1.0)
    assert six.config.simulation.places["r1"][:2] == (1.0, 0.5)


def test_settings_hold_for_all_or_for_one(tmp_path):
    plan = build(tmp_path, "consensus", "--set", "value=7", "--set", "r2.value=3", "--algorithm", "thesis")
    assert [parameters["value"] for parameters in plan.parameters.values()] == [7, 7, 3]
    assert plan.algorithm == "thesis"
    with pytest.raises(ConfigError, match="the robots are r0, r1, r2"):
        build(tmp_path, "consensus", "--set", "r9.value=3")


def test_a_run_until_it_has_converged_has_a_last_iteration(tmp_path):
    assert build(tmp_path, "consensus").iterations == 100
    assert build(tmp_path, "consensus", "--until", "converged").run_options.last == 10_000
    assert build(tmp_path, "consensus", "--until", "converged", "--iterations", "7").iterations == 7
    assert build(tmp_path, "consensus", "--until", "converged", "--for", "9").iterations is None


def test_step_sizes_are_given_in_the_thesis_unit(tmp_path):
    plan = build(tmp_path, "localization", "--algorithm", "thesis", "--step-size", "4e-6")
    assert plan.parameters["r0"]["step_size"] == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("source", "simulated"),
    [("bus:swarm/{robot}/mocap", "bus:swarm/{robot}/mocap"), ("serial:/dev/serial0", "serial:RUN/{robot}/dwm.tty")],
)
def test_poses_come_from_the_bus_where_the_config_says_so_and_else_from_simulated_modules(tmp_path, source, simulated):
    config = build(tmp_path, "consensus").config
    path = tmp_path / "swarm.toml"
    path.write_text(dump(replace(config, dwm=replace(config.dwm, source=source))))
    plan = build(tmp_path, "consensus", "--config", str(path))
    assert plan.config.dwm.source == simulated.replace("RUN", str(tmp_path))


def test_the_config_a_run_uses_is_a_valid_file(tmp_path):
    for robots in (1, 2, 6, 40):
        plan = build(tmp_path, "localization", "--robots", str(robots), "--topology", "loop")
        text = dump(plan.config)
        assert parse(text, plan.config.path) == plan.config
        assert len(set(plan.config.simulation.places.values())) == robots


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["consensus", "--topology", "star"], "--topology star: expected line"),
        (["consensus", "--topology", "thesis-d"], "six robots"),
        (["consensus", "--cut", "r0-r2@1s,1s"], "no such link"),
        (["missing.py"], "no such file"),
        (["nonsense"], "expected consensus, flooding_demo, "),
        (["consensus", "--algorithm", "magic"], "expected 'metropolis' or 'thesis'"),
        (["consensus", "--set", "valu=3"], "unknown parameter 'valu'"),
        (["flooding_demo", "--iterations", "5"], "--iterations: flooding_demo has none, it reacts to events"),
        (["stand_up", "--until", "converged"], "--until and --for are for apps in lockstep, which stand_up is not"),
        (["flooding_demo", "--for", "5"], "--until and --for are for apps in lockstep"),
        (["consensus", "--noise", "none"], "--noise: consensus takes no measurements"),
        (["flooding_demo", "--noise", "none", "--seconds", "2", "--virtual"], "--noise: flooding_demo takes no"),
    ],
)
def test_wrong_scenarios_are_refused(tmp_path, arguments, words):
    with pytest.raises(LocalError, match=words):
        build(tmp_path, *arguments)


def test_a_matrix_file_is_a_topology(tmp_path):
    matrix = tmp_path / "ring.csv"
    matrix.write_text("0,1,1\n1,0,1\n1,1,0\n")
    assert len(build(tmp_path, "consensus", "--topology", str(matrix)).config.edges) == 3
    matrix.write_text("0,1,1\n0,0,1\n1,1,0\n")
    with pytest.raises(ConfigError, match="not symmetric"):
        build(tmp_path, "consensus", "--topology", str(matrix))
    matrix.write_text("0 0.5 1\n0.5 0 1\n1 1 0\n")
    with pytest.raises(ConfigError, match=r"row of r0, column of r1: expected 0 or 1, got 0\.5"):
        build(tmp_path, "consensus", "--topology", str(matrix))
    matrix.write_text("0 1 0\n1 0 0\n0 0 0\n")
    with pytest.raises(ConfigError, match="not connected: these parts cannot reach each other: r0 r1; r2"):
        build(tmp_path, "consensus", "--topology", str(matrix))
    matrix.write_text("0,x\n1,0\n")
    with pytest.raises(ConfigError, match=r"ring\.csv"):
        build(tmp_path, "consensus", "--topology", str(matrix))


def test_a_missing_recording_is_named(tmp_path):
    with pytest.raises(RecordingError, match="nowhere"):
        build(tmp_path, "localization", "--replay", str(tmp_path / "nowhere"))


def test_a_run_directory_too_deep_for_sockets_is_refused(tmp_path):
    deep = tmp_path / ("d" * 100)
    with pytest.raises(BusError, match="107"):
        scenario.build(options.parse(["consensus"]), deep)


def test_a_file_describes_the_swarm(tmp_path):
    plan = build(tmp_path, "consensus", "--robots", "2")
    path = tmp_path / "swarm.toml"
    path.write_text(dump(replace(plan.config, network="mine")))
    again = build(tmp_path, "consensus", "--config", str(path), "--set", "value=1")
    assert again.config.network == "mine"
    assert again.config.names == ("r0", "r1")


def test_a_step_size_beyond_the_limit_of_the_scene_is_refused(tmp_path):
    thesis = ("localization", "--algorithm", "thesis", "--step-size")
    plan = build(tmp_path, *thesis, "4e-6")
    assert plan.notes[0].startswith("step size 4e-06 1/cm^2 = 0.04 1/m^2, limit 7.3")  # 7.3e-6 on the 3-line of 2 m
    assert len(plan.notes) == 1
    assert "warning" in build(tmp_path, *thesis, "7e-6").notes[1]
    with pytest.raises(LocalError, match="would diverge"):
        build(tmp_path, *thesis, "8e-6")


def test_only_a_built_in_app_is_said_to_wait_for_a_button(tmp_path):
    own = tmp_path / "stand_up.py"
    own.write_text("from swarm import SyncApp\nclass Own(SyncApp):\n    value: float\n    def step(self, n): pass\n")
    assert "waits for a button" in build(tmp_path, "stand_up").notes[0]
    assert build(tmp_path, str(own)).notes == ()


def test_measurements_are_made_for_a_run_that_ends_by_its_time(tmp_path):
    recorded = build(tmp_path, "localization", "--noise", "none", "--for", "2").recordings
    assert {len(each.rows) for each in recorded.values()} == {2000}
