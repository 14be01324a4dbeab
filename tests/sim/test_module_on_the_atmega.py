"""A swarm whose DWM1001 modules hang on the ATmega: ranges go through simulated firmware, I2C, balancer and dwm."""

from dataclasses import replace
from pathlib import Path

import pytest

from bench.rigs.simulation import Simulation
from sim.scenario import options, scenario
from swarm.config.dump import dump


@pytest.mark.slow
def test_robots_find_the_target_by_what_the_atmega_hears(tmp_path: Path) -> None:
    config = scenario.build(options.parse(["localization"]), tmp_path).config
    path = tmp_path / "swarm.toml"
    path.write_text(dump(replace(config, dwm=replace(config.dwm, source="balancer"))))
    with Simulation("localization", "--config", str(path), "--iterations", "300") as simulation:
        report = simulation.finish()
    assert report["problems"] == []
    assert report["iterations"] == 300
    assert report["error_cm"] < 15
