"""What a recording of virtual time says of apps, links and robots is what they did."""

from pathlib import Path

import pytest
from conftest import thinned

from sim.virtual.run import run_virtually
from swarm.recording.run import Run

Told = list[tuple[float, str, dict]]


def recorded(place: Path, *arguments: str) -> Told:
    """Time, topic and message of all that a run has recorded."""
    run_virtually(*arguments, "--record", str(place))
    return [(sample.t, sample.topic, sample.message) for sample in Run(place).samples()]


@pytest.mark.parametrize(
    "arguments",
    thinned(["formation --iterations 30", "led_sync --seconds 5", "stand_up --press r0.A@1s --iterations 6"]),
)
def test_an_app_that_runs_is_not_recorded_as_waiting(tmp_path: Path, arguments: str) -> None:
    told = recorded(tmp_path, *arguments.split(), "--robots", "3")
    app = arguments.split()[0]
    for robot in ("r0", "r1", "r2"):
        phases = [message["phase"] for _, topic, message in told if topic == f"swarm/{robot}/app/{app}/progress"]
        begun = phases.index("running")
        assert "waiting" not in phases[begun:]
        assert phases.count("done") == ("--iterations" in arguments)


def test_links_are_recorded_as_up_from_when_they_are(tmp_path: Path) -> None:
    told = recorded(tmp_path, "consensus", "--robots", "3", "--iterations", "60")
    for robot in ("r0", "r1", "r2"):
        states = {
            t: {link["state"] for link in message["links"]}
            for t, topic, message in told
            if topic == f"swarm/{robot}/mesh/links"
        }
        assert min(t for t, found in states.items() if found == {"up"}) < 0.1


def test_a_power_cycle_is_a_restart() -> None:
    report, outcome = run_virtually(
        *("consensus", "--robots", "3", "--topology", "loop", "--seconds", "12", "--absent", "drop"),
        *("--off", "r1@1s,2s", "--off", "r1@6s,1s", "--off", "r2@start,1s"),
    )
    assert outcome.restarts == {"r0": 0, "r1": 2, "r2": 0}
    assert report["restarts"] == 2
