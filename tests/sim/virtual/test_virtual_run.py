"""Whole runs under virtual time: as the cores alone compute them, the same bytes each time, whatever happens."""

from pathlib import Path

import pytest

from sim.report import fault, summary
from sim.report_table import table
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, run_virtually
from sim.virtual.run import VirtualRun as Virtual
from swarm.errors import ConfigError
from swarm.messages import SetAppParameters, read
from swarm.recording.run import Run
from swarm.recording.thesis_ranges import cost

EDGES_OF_LINE = 5
SIX = ("consensus", "--robots", "6", "--iterations", "60")


def values(outcome):
    return {name: [path.rows[k] for k in range(path.last + 1)] for name, path in outcome.trajectories.items()}


@pytest.fixture(scope="module")
def undisturbed():
    return run_virtually(*SIX, rows=True)


def test_consensus_ends_on_the_mean_in_the_time_of_the_links(undisturbed):
    report, outcome = undisturbed
    assert report["iterations"] == 60
    assert report["problems"] == []
    assert report["iteration_s_median"] == pytest.approx(0.03)
    assert report["messages_per_iteration"] == pytest.approx(2 * EDGES_OF_LINE, abs=0.5)
    assert report["error"] < 0.01
    assert outcome.seconds == pytest.approx(59 * 0.03)
    assert outcome.trajectories["r5"].rows[0] == ("5.0", "5.0")


@pytest.mark.parametrize(
    "disturbance",
    [
        ("--jitter", "10ms"),
        ("--jitter", "10ms", "--bandwidth", "2kB"),
        ("--cut", "r2-r3@0.5s,2s", "--cut", "r0-r1@0.6s,8s"),
        ("--latency", "0ms"),
        ("--loss", "30%", "--jitter", "5ms"),
        ("--seed", "7", "--jitter", "25ms"),
    ],
)
def test_whatever_the_links_do_the_trajectory_stays_bit_equal(undisturbed, disturbance):
    report, outcome = run_virtually(*SIX, *disturbance, rows=True)
    assert report["problems"] == []
    assert values(outcome) == values(undisturbed[1])


def test_jitter_and_cuts_cost_the_time_that_they_should(undisturbed):
    jittered, _ = run_virtually("consensus", "--robots", "6", "--iterations", "600", "--jitter", "10ms")
    # An independent model of lockstep on such links has 39.4 ms on a line of six, 1.4 ms of them for steps and bytes.
    assert jittered["iteration_s_median"] == pytest.approx(0.0380, abs=0.0006)
    lossy, _ = run_virtually("consensus", "--robots", "6", "--iterations", "600", "--loss", "50%")
    # Of two neighbours' frames the later one counts: at a loss of one half that is lost 5/3 times, for one 1 time.
    assert 0.03 + 3.75e-3 < lossy["iteration_s_median"] < 0.03 + 3 * 3.75e-3
    cut, _ = run_virtually(*SIX, "--cut", "r2-r3@0.5s,2s")
    assert cut["seconds"] == pytest.approx(undisturbed[0]["seconds"] + 2.0, abs=0.15)


def test_a_loop_goes_on_around_a_link_that_never_comes_back():
    loop = (*SIX, "--topology", "loop")
    report, outcome = run_virtually(*loop, "--cut", "r0-r1@0.5s,1000s", rows=True)
    assert report["problems"] == []
    assert values(outcome) == values(run_virtually(*loop, rows=True)[1])
    # Over the other five links, of 30 ms each.
    assert report["iteration_s_median"] == pytest.approx(5 * 0.03, abs=0.005)


def test_equal_seeds_give_equal_recordings_and_others_do_not(tmp_path):
    def files(name, *arguments):
        folder = tmp_path / name
        run_virtually(*SIX, "--jitter", "10ms", "--record", str(folder), *arguments)
        return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}

    first = files("a")
    assert first == files("b")
    assert sorted(first) == ["consensus.mcap", "run.toml", "swarm.toml"]
    assert first != files("c", "--seed", "2")


def test_a_robot_alone_and_an_automatic_topology_run():
    report, _ = run_virtually("consensus", "--robots", "1", "--iterations", "5")
    assert report["iterations"] == 5
    report, _ = run_virtually("consensus", "--robots", "5", "--topology", "auto", "--iterations", "20")
    assert report["iterations"] == 20


def test_the_report_says_which_messages_of_an_app_without_steps_it_counts():
    report, outcome = run_virtually("unicast_demo", "--robots", "3", "--press", "r0.A@1s", "--seconds", "3")
    counted = f"messages    {report['messages']} states and acknowledgements between the robots"
    assert counted in table(report, outcome).splitlines()


def test_a_fault_of_the_app_is_named_with_robot_and_iteration(tmp_path):
    app = tmp_path / "bad.py"
    app.write_text(
        "from swarm import SyncApp\n\n\nclass Bad(SyncApp):\n    value: float\n\n"
        "    def step(self, neighbours):\n        self.value = 1.0 / (3 - self.k) if self.robot.name == 'r1' else 0.0\n"
    )
    report, _ = run_virtually(str(app), "--robots", "3", "--iterations", "20")
    assert len(report["problems"]) == 1
    assert "r1" in report["problems"][0]
    assert "iteration 3" in report["problems"][0]
    assert "ZeroDivisionError" in report["problems"][0]


def test_a_run_that_cannot_go_on_says_who_is_waited_for():
    report, _ = run_virtually(*SIX, "--cut", "r2-r3@0.5s,1000s")
    (problem,) = report["problems"]
    assert "r3" in problem
    assert "no iteration for" in problem


def test_localization_measures_and_finds_the_target():
    report, _ = run_virtually("localization", "--robots", "3", "--iterations", "60")
    assert report["problems"] == []
    assert report["error_cm"] < 8


def test_a_replay_ends_where_the_recording_does(tmp_path):
    """Rows come as the dwm service would answer them."""
    measured = [(60.0 + k, 50.0, 150.0 - k) for k in range(12)]
    rows = "100,0,0,0,0,0,0\n" + "".join(
        f"{101 + k},0,0,0,0,0,0,0,{cost(distance, 0.0, 0.0, x, y)},{distance},{x},{y}\n"
        for k, (distance, x, y) in enumerate(measured)
    )
    for robot in range(2):
        (tmp_path / f"{robot}.csv").write_text(rows)
    report, outcome = run_virtually("localization", "--replay", str(tmp_path), "--latency", "0ms")
    assert report["problems"] == []
    assert report["iterations"] == outcome.scenario.iterations == 12


EXAMPLES = Path(__file__).parents[3] / "examples"
BLINK = """
from math import fsum

from swarm import PeriodicApp, SyncApp, channel


class Frequency(SyncApp):
    value: float

    def step(self, neighbours):
        self.value += fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))


class Blink(PeriodicApp):
    on: bool
    f: float
    frequency = channel(Frequency)

    def start(self):
        self.frequency.value = 1.0 + self.robot.swarm.index(self.robot.name)

    def step(self, neighbours):
        self.f = self.frequency.value
        self.on = not self.on
        self.robot.leds(green=self.on)
"""


def test_robots_without_an_app_stand_and_a_push_topples_one():
    report, _ = run_virtually("--robots", "2", "--seconds", "3", "--push", "r1@1s,0.6")
    assert report["result"]["r0"] == {"mode": "balancing", "tilt_deg": 0.0, "fault": ""}
    assert report["result"]["r1"]["mode"] != "balancing"


def test_a_button_reaches_an_event_driven_app_and_its_neighbours():
    app = str(EXAMPLES / "button_count.py")
    report, _ = run_virtually(app, "--robots", "3", "--seconds", "4", "--press", "r1.A@1s", "--press", "r1.A@2s")
    assert all(result["presses"] == 2 for result in report["result"].values())


def test_a_channel_runs_beside_the_periodic_app_that_it_belongs_to(tmp_path):
    app = tmp_path / "blink.py"
    app.write_text(BLINK)
    records = tmp_path / "records"
    report, outcome = run_virtually(str(app), "--robots", "4", "--iterations", "40", "--record", str(records))
    assert report["problems"] == []
    assert report["iterations"] == 40
    assert all(result["f"] == pytest.approx(2.5, abs=0.01) for result in report["result"].values())
    times = outcome.trajectories["r0"].times
    assert times[40] - times[1] == pytest.approx(3.9)
    recorded = Run(records)
    assert recorded.states()[""]["r0"] == "swarm/r0/app/blink/state"
    assert recorded.states()["frequency"]["r0"] == "swarm/r0/app/blink/frequency/state"
    assert recorded.trajectories()["r3"].value(40, "f") == pytest.approx(2.5, abs=0.01)


def test_a_fault_of_a_handler_is_named(tmp_path):
    app = tmp_path / "bad.py"
    app.write_text(
        "from swarm import EventApp\n\n\nclass Bad(EventApp):\n    value: int\n\n"
        "    def on_button(self, button):\n        raise RuntimeError(button)\n"
    )
    report, _ = run_virtually(str(app), "--robots", "3", "--seconds", "5", "--press", "r2.C@1s")
    (problem,) = report["problems"]
    assert "r2" in problem
    assert "RuntimeError: c" in problem


def test_an_app_that_waits_for_events_ends_when_nothing_happens():
    report, _ = run_virtually(str(EXAMPLES / "button_count.py"), "--robots", "2", "--press", "r0.A@1s")
    assert report["problems"] == []
    assert report["result"]["r1"] == {"presses": 1}


@pytest.mark.slow
def test_an_app_that_never_rests_and_has_no_iterations_ends():
    report, _ = run_virtually("led_sync", "--algorithm", "thesis", "--robots", "2")
    assert report["problems"] == []
    assert report["seconds"] == 120.0


def test_a_periodic_app_follows_an_automatic_topology(tmp_path):
    """A link that is cut is made up for by others: whom an app has as neighbours is who tells it its state."""
    app = tmp_path / "near.py"
    app.write_text(
        "from swarm import PeriodicApp\n\n\nclass Near(PeriodicApp):\n    count: int\n    period = 0.5\n"
        '    _seen: str = ""\n    _changes: int = 0\n\n'
        "    def step(self, neighbours):\n        self.count += 1\n"
        '        near = " ".join(n.name for n in neighbours)\n'
        "        self._changes += near != self._seen\n        self._seen = near\n\n"
        "    def result(self):\n"
        '        links = " ".join(self.robot.neighbours)\n'
        '        return {"near": self._seen, "links": links, "changes": self._changes}\n'
    )
    auto = ("--robots", "5", "--topology", "auto", "--iterations", "120", "--cut", "r0-r1@30s,100s")
    report, _ = run_virtually(str(app), *auto)
    results = report["result"].values()
    assert all(result["near"] == result["links"] for result in results)
    assert max(result["changes"] for result in results) == 2


def test_parameters_of_a_channel_change_while_it_runs(tmp_path):
    app = tmp_path / "tuned.py"
    app.write_text(
        "from swarm import PeriodicApp, SyncApp, channel, parameter\n\n\n"
        "class Hold(SyncApp):\n    value: float\n    gain: float = parameter(0.5, low=0, high=1, live=True)\n"
        "    fixed: int = parameter(3)\n\n"
        "    def step(self, neighbours):\n        self.value = self.gain\n\n\n"
        "class Tuned(PeriodicApp):\n    x: float\n    inner = channel(Hold)\n    inner_most: float = parameter(1.0)\n"
        '    _told: str = ""\n\n'
        "    def step(self, neighbours):\n        self.x = self.inner.value\n\n"
        "    def on_parameter(self, name):\n        self._told += name\n\n"
        '    def result(self):\n        return {"x": self.x, "told": self._told, "most": self.inner_most}\n'
    )
    options = parse([str(app), "--virtual", "--robots", "2", "--seconds", "4", "--set", "inner_gain=0.25"])
    run = Virtual(options, build(options, PLACE))
    bus, answers, told = run.world.robots["r0"].meshes_bus, [], []
    bus.subscribe("swarm/r0/app/tuned/parameters_set", lambda name, data: answers.append(read(name, data).problem))
    bus.subscribe("swarm/r0/app/tuned/parameters", lambda name, data: told.append(read(name, data).parameters))
    for at, values in enumerate(({"inner_gain": 0.75, "inner_most": 2.0}, {"inner_gain": 1.5}, {"inner_fixed": 4}), 1):
        change = SetAppParameters(str(at), values)
        run.world.time.at(float(at), bus.publish, "swarm/r0/app/tuned/set/parameters", change)
    report = summary(run.go())
    assert report["problems"] == []
    assert report["result"]["r0"] == {"x": 0.75, "told": "inner_gaininner_most", "most": 2.0}
    assert report["result"]["r1"] == {"x": 0.25, "told": None, "most": 1.0}
    assert answers == [
        "",
        "app tuned on r0: channel inner: gain: expected a finite number from 0 to 1, got 1.5",
        "app tuned on r0: channel inner: fixed: cannot be changed while the app runs: it is declared without live=True",
    ]
    assert told[0]["inner_gain"].value == 0.25
    assert told[-1]["inner_gain"].value == 0.75
    assert told[-1]["inner_fixed"].live is False


def test_a_run_without_latency_needs_a_limit_of_iterations():
    with pytest.raises(ConfigError, match="--latency 0: such a run needs --iterations"):
        run_virtually("consensus", "--robots", "2", "--latency", "0ms", "--seconds", "1")
    report, _ = run_virtually("consensus", "--robots", "2", "--latency", "0ms", "--iterations", "20")
    assert report["iterations"] == 20


def test_a_run_of_less_than_a_second_ends_in_time():
    report, _ = run_virtually("consensus", "--robots", "2", "--seconds", "0.3")
    assert report["seconds"] == pytest.approx(0.3, abs=0.05)


def test_a_run_for_some_seconds_ends_though_a_robot_never_comes_to_its_first_iteration(tmp_path):
    file = tmp_path / "fails.py"
    file.write_text(
        "from swarm import SyncApp\nclass Fails(SyncApp):\n    value: float\n    def start(self):\n"
        "        if self.robot.name == 'r1':\n            raise ValueError('broken')\n"
        "    def step(self, neighbours):\n        self.value += 1\n"
    )
    report, _ = run_virtually(str(file), "--robots", "3", "--seconds", "5", "--absent", "drop", "--drop-after", "2")
    assert any("broken" in problem for problem in report["problems"])
    assert report["seconds"] < 100


def test_a_robot_that_is_switched_off_twice_before_its_app_begins_runs_it_once():
    """With an automatic topology an app waits for its links."""
    text = "led_sync --robots 3 --topology auto --seconds 30 --virtual --off r1@1s,1s --off r1@2500ms,3s"
    options = parse(text.split())
    run = Virtual(options, build(options, PLACE))
    robot = run.world.robots["r1"]
    hosts = []

    class Apps(dict):
        def __setitem__(self, name, host):
            hosts.append(host)
            super().__setitem__(name, host)

    robot.apps = Apps()
    run.go()
    running = [host for host in hosts if not host._closed]
    assert running == list(robot.apps.values())


def test_a_robot_that_is_off_stays_off_for_longer_when_it_is_switched_off_again():
    report, _ = run_virtually(
        "consensus", "--robots", "3", "--iterations", "300", "--off", "r1@1s,2s", "--off", "r1@2s,5s"
    )
    assert report["seconds"] > 7.0


@pytest.mark.parametrize("name", ["stand_up", "localization", "formation", "led_sync"])
def test_an_authors_app_with_the_name_of_a_built_in_one_is_the_authors(tmp_path, name):
    file = tmp_path / f"{name}.py"
    file.write_text(
        "from swarm import SyncApp\nclass Mine(SyncApp):\n    value: float\n    def step(self, neighbours):\n"
        "        self.value += 1\n"
    )
    report, outcome = run_virtually(str(file), "--robots", "2")
    assert report["app"] == file.stem
    assert report["iterations"] == 100
    assert outcome.scenario.lying is None
    assert not report.keys() & {"error_cm", "misfit_m", "synchronous_after_s"}
    table(report, outcome)


def test_a_problem_names_robot_and_app_once(tmp_path):
    app = tmp_path / "fails.py"
    app.write_text(
        "from swarm import SyncApp\n\nclass Fails(SyncApp):\n    x: float\n\n    def step(self, neighbours):\n"
        "        if self.k == 2 and self.robot.name == 'r1':\n            raise ValueError('two\\nlines')\n"
    )
    report, _ = run_virtually(str(app), "--robots", "2")
    assert report["problems"] == [f"Fails on r1, iteration 2: {app}, line 8: ValueError: two lines"]
    assert fault("r1", "app", "state lost at r1") == "r1 app state lost at r1"
