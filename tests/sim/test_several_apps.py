"""Several apps at once on each robot, in both simulations: recorded, drawn and played back each for itself."""

import json
import signal
from pathlib import Path

import pytest

from bench.rigs.simulation import Simulation
from laptop.cli import main
from sim.scenario import options, scenario
from sim.virtual.run import PLACE, run_virtually
from swarm.errors import ConfigError
from swarm.recording.run import Run

EXAMPLES = Path(__file__).parents[2] / "examples"
THREE = ("consensus", "led_sync", "localization", "--robots", "3", "--iterations", "60")


def cli(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, arguments)])
    return ended.value.code


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    place = tmp_path_factory.mktemp("several")
    report, _ = run_virtually(*THREE, "--record", str(place))
    return report, place


def test_each_is_reported_and_the_first_says_when_it_ends(recorded):
    report, _ = recorded
    assert report["app"] == "consensus"
    assert report["iterations"] == 60
    assert report["error"] < 1e-6
    assert report["problems"] == []
    assert set(report["beside"]) == {"led_sync", "localization"}
    x, y = (report["beside"]["localization"]["result"]["r0"][name] for name in "xy")
    assert (x, y) == pytest.approx((0.5, 1.0), abs=0.1)


def test_each_computes_what_it_does_alone(recorded):
    _, place = recorded
    _, alone = run_virtually("consensus", "--robots", "3", "--iterations", "60", rows=True)
    run = Run(place)
    assert run.app == "consensus"
    for name, path in run.trajectories().items():
        assert path.rows == alone.trajectories[name].rows


def test_each_has_its_recording(recorded, tmp_path, capsys, monkeypatch):
    _, place = recorded
    assert {path.name for path in place.iterdir()} == {
        "run.toml", "swarm.toml", "consensus.mcap", "led_sync.mcap", "localization.mcap"
    }  # fmt: skip
    assert Run(place).apps == ("consensus", "led_sync", "localization")
    monkeypatch.chdir(tmp_path)
    assert cli("export", place, "--table", tmp_path / "t", "--app", "localization") == 0
    assert (tmp_path / "t" / "r0.localization.csv").read_text().startswith("k,t,")
    capsys.readouterr()
    assert cli("replay", place, "swarm/r1/app/led_sync/**", "--json") == 0
    keys = {json.loads(line)["key"] for line in capsys.readouterr().out.splitlines()}
    assert "swarm/r1/app/led_sync/parameters" in keys
    assert all(key.startswith("swarm/r1/app/led_sync/") for key in keys)


def test_each_app_of_a_run_can_be_drawn(recorded, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    _, place = recorded
    monkeypatch.chdir(tmp_path)
    assert cli("plot", place) == 0
    assert cli("plot", place, "--app", "localization") == 0
    assert cli("plot", place, "--app", "led_sync", "--kind", "iterations") == 0
    assert capsys.readouterr().out.split() == [
        f"{place.name}-states.png", f"{place.name}-localization-map.png", f"{place.name}-led_sync-iterations.png"
    ]  # fmt: skip
    assert cli("plot", place, "--app", "goto") == 2
    assert "no app goto is recorded; there are: consensus, led_sync, localization" in capsys.readouterr().err


def test_several_apps_record_the_same_bytes_with_the_same_seed(recorded, tmp_path):
    _, place = recorded
    run_virtually(*THREE, "--record", str(tmp_path))
    for path in place.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_messages_of_one_app_are_not_anothers(tmp_path):
    """Both have asked the same mesh, each with tickets of its own."""
    press = ("--press", "r0.A@1s", "--seconds", "3")
    report, _ = run_virtually("unicast_demo", "flooding_demo", "--robots", "3", *press, "--record", str(tmp_path))
    assert report["result"]["r0"] == {"sent": 1, "delivered": 1, "received": 0}
    assert report["beside"]["flooding_demo"]["result"]["r0"]["complete"] == 1
    asked = [sample.message["ticket"] for sample in Run(tmp_path).samples("swarm/r0/app/*/asked")]
    assert len(set(asked)) == 2


def test_a_fault_beside_is_named_and_the_others_go_on(tmp_path):
    app = tmp_path / "bad.py"
    app.write_text(
        "from swarm import SyncApp\n\n\nclass Bad(SyncApp):\n    value: float\n\n"
        "    def step(self, neighbours):\n        if self.k == 5 and self.robot.name == 'r1':\n"
        "            raise RuntimeError('oh')\n"
    )
    report, _ = run_virtually("consensus", str(app), "--robots", "3", "--iterations", "40")
    assert report["iterations"] == 40
    (problem,) = report["problems"]
    assert problem.startswith("Bad on r1, iteration 5: ")
    assert "RuntimeError: oh" in problem


def test_a_run_that_fails_before_its_first_state_has_no_plot_and_is_no_wrong_command(tmp_path, capsys):
    app = tmp_path / "bad.py"
    app.write_text(
        "from swarm import EventApp\n\n\nclass Bad(EventApp):\n    def start(self):\n        raise RuntimeError('oh')\n"
    )
    assert cli("sim", app, "--virtual", "--robots", "2", "--plot", tmp_path / "bad.png") == 1
    said = capsys.readouterr()
    assert "plot        none: no robot has recorded a state" in said.out
    assert "is recorded" not in said.err


def test_a_parameter_is_that_of_the_app_it_names():
    arguments = (
        "consensus",
        "led_sync",
        "--set",
        "led_sync/r1.frequency_value=3.0",
        "--set",
        "r0.value=7.0",
        "--virtual",
    )
    config = scenario.build(options.parse(list(arguments)), PLACE).config
    assert config.app("led_sync").of("r1")["frequency_value"] == 3.0
    assert config.app("consensus").of("r0")["value"] == 7.0
    assert "value" not in config.app("led_sync").of("r0")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("consensus", "consensus"), "consensus is there twice"),
        (("consensus", "--set", "goto/speed=0.1"), "the apps are consensus"),
    ],
)
def test_what_cannot_be_is_said(arguments, words):
    with pytest.raises(ConfigError, match=words):
        scenario.build(options.parse([*arguments, "--virtual"]), PLACE)


@pytest.mark.slow
def test_real_processes_run_several_apps_too():
    with Simulation("consensus", "localization", "--seconds", "600") as simulation:
        simulation.wait_for("r0", 100)
        simulation.wait_for("r0", 11, app="localization")
        simulation.process.send_signal(signal.SIGINT)
        report = simulation.finish()
        run = Run(simulation.records)
    assert report["problems"] == []
    assert report["error"] < 1e-6
    assert report["beside"]["localization"]["iterations"] > 10
    assert run.app == "consensus"
    assert run.apps == ("consensus", "localization")
