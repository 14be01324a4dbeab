"""The runs of consensus from which `swarm measure radio` fits the slot radio, on real robots.

For each experiment the robots get a configuration of their own, as `swarm deploy` brings it; then they run consensus
without sleeps, and `swarm fetch` brings the recording. In the end they get their configuration back.
"""

import argparse
import dataclasses
import json
import re
import subprocess
import sys
import time
from pathlib import Path

from swarm.config import Config
from swarm.config.dump import dump
from swarm.config.types import GRAPH, MAX_RFCOMM_LINKS, STAR
from swarm.core.graph import Graph
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.onboard.command_line import complain

APP = "consensus"
LEAST = 3
"""Robots of the smallest experiment."""
PATIENCE_S = 1800.0
"""Seconds for one run: 300 iterations over the thesis' slowest links take 1100 s."""
LOOK_EVERY_S = 5.0


@frozen
class Experiment:
    """One run, as the page docs/how-to/network/fit-the-radio.md lists it."""

    shape: str
    links: str
    robots: int

    @property
    def name(self) -> str:
        """The folder of its recording: `star-6` for links of a star, else `loop-6`."""
        return f"{self.links if self.links == STAR else self.shape}-{self.robots}"


def experiments(robots: int) -> list[Experiment]:
    """Return what so many robots can do. Raises `LocalError` for fewer than three."""
    if robots < LEAST:
        raise LocalError(f"the experiments need {LEAST} robots, the configuration has {robots}")
    found = [Experiment("line", GRAPH, LEAST), Experiment("loop", GRAPH, LEAST)]
    more = min(robots, MAX_RFCOMM_LINKS + 1)
    return found if more == LEAST else [*found, Experiment("loop", STAR, more), Experiment("loop", GRAPH, more)]


def config_of(config: Config, experiment: Experiment) -> Config:
    """Return the configuration of the first robots for an experiment. Raises `LocalError`."""
    robots = config.robots[: experiment.robots]
    names = [robot.name for robot in robots]
    edges = Graph.of_shape(experiment.shape, names).edges
    return dataclasses.replace(
        config,
        robots=robots,
        auto=False,
        edges=edges,
        mesh=dataclasses.replace(config.mesh, links=experiment.links),
        bodies={name: body for name, body in config.bodies.items() if name in names},
        balancings={name: balancing for name, balancing in config.balancings.items() if name in names},
        simulation=dataclasses.replace(config.simulation, places={}),
        apps={},
    )


class Laboratory:
    """Robots that carry the experiments out, by the commands that a person would give."""

    def __init__(self, args: argparse.Namespace, config: Config) -> None:
        """`args`: `--into`, `--iterations`, `--ssh-config`."""
        self._config = config
        self._folder: Path = args.into
        self._iterations: int = args.iterations
        self._way = [] if args.ssh_config is None else ["--ssh-config", str(args.ssh_config)]

    def go(self) -> list[Path]:
        """Carry out all experiments, and return the folders of their recordings. Raises `LocalError`."""
        planned = experiments(len(self._config.robots))
        self._folder.mkdir(parents=True, exist_ok=True)
        try:
            return [self._one(experiment) for experiment in planned]
        finally:
            self._give_back()

    def _give_back(self) -> None:
        """Deploy the robots' own configuration. A failure of it is told and not raised, since the reason why a run has
        failed matters more; also where Ctrl-C was pressed again."""
        path = self._config.path
        try:
            self._swarm("deploy", path)
        except (LocalError, KeyboardInterrupt) as error:
            complain("swarm", str(error) or "interrupted")
            way = f"swarm deploy --config {path}"
            complain("swarm", f"robots may still have an experiment's configuration, or no mesh: {way}")
            if isinstance(error, KeyboardInterrupt):
                raise

    def _one(self, experiment: Experiment) -> Path:
        path = self._folder / f"{experiment.name}.toml"
        path.write_text(dump(config_of(self._config, experiment)), encoding="utf-8")
        away = [robot.name for robot in self._config.robots[experiment.robots :]]
        if away:  # their calls would take the radio of the others
            self._swarm("services stop mesh", self._config.path, "--robots", ",".join(away))
        self._swarm("deploy", path)
        said = self._swarm("run", path, APP, "--iterations", str(self._iterations))
        found = re.search(rf"{APP}-[0-9a-f]+", said)
        if found is None:
            raise LocalError(f"swarm run does not name its run: {said}")
        self._until_done(path)
        self._swarm("fetch", path, found[0], "--no-logs", "--into", str(self._folder / experiment.name))
        return self._folder / experiment.name / found[0]

    def _until_done(self, path: Path) -> None:
        ends = time.monotonic() + PATIENCE_S
        while True:
            robots = json.loads(self._swarm("status", path, "--json"))["robots"]
            phases = {name: row.get("apps", {}).get(APP, {}).get("phase", "silent") for name, row in robots.items()}
            if set(phases.values()) == {"done"}:
                return
            faults = [name for name, phase in phases.items() if phase == "fault"]
            if faults or time.monotonic() > ends:
                why = ", ".join(f"{name} {phase}" for name, phase in phases.items())
                raise LocalError(f"{APP} has not ended on all robots: {why}; swarm logs {APP} --config {path}")
            time.sleep(LOOK_EVERY_S)

    def _swarm(self, command: str, path: Path, *words: str) -> str:
        """Carry out a command of `swarm` and return its output. Raises `LocalError` where it fails; the exit code 1 of
        `status` only says that a service does not run, which is not asked here."""
        command_line = [*command.split(), *words, "--config", str(path), *self._way]
        told = f"swarm {' '.join(command_line)}"
        if command != "status":
            sys.stderr.write(f"$ {told}\n")
        process = [sys.executable, "-P", "-m", "laptop.cli", *command_line]
        done = subprocess.run(process, check=False, stdout=subprocess.PIPE, text=True)
        if done.returncode != 0 and (command != "status" or done.returncode != 1):
            raise LocalError(f"{told} has failed:\n{done.stdout}")
        return done.stdout
