"""`swarm.simulate`: a run in virtual time from a program, a test or a notebook."""

import shutil
import sys
import tempfile
import warnings
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import Any

from laptop.runs.progress import progress as shown_progress
from laptop.runs.results import RunData
from services.apps import loader
from sim.processes.progress import say
from sim.scenario.command import keep_command
from sim.scenario.notes import forgetting
from sim.scenario.options import EVENTS, parse, parser
from sim.scenario.quantities import AppSetting
from sim.scenario.scenario import build
from sim.scenario.values import settings_from_values
from sim.virtual.run import PLACE, VirtualRun
from swarm import config as configuration
from swarm.app.settings import Setting
from swarm.app.sync_app import BaseApp
from swarm.core.lockstep.stopping import is_unmet
from swarm.errors import AppError, ConfigError, shown
from swarm.recording.recorded_topics import TOPICS

App = type[BaseApp] | str | Path

ROBOTS = 6
"""Robots of a simulation that names none."""

DEVICES = ("dwm/pose", "balancer/state", "mesh/links", "mesh/clock", "mesh/topology", "mesh/members")
"""What is recorded with `devices` alone: to compute it takes longer than the run of a small app, and each robot's
message of the topology or of the members grows with the swarm."""

ELSEWHERE = {"apps", "help", "json", "plot", "record", "run_dir", "settings", "view", "virtual", "speed", "no_open",
             "demo", "replay", "seconds", "iterations", "seed", "latency", "robots", "topology", "cuts", "kills",
             "offs", "presses", "pushes"}  # fmt: skip
"""Options of `swarm sim` that are no `**options` of `simulate`."""


def simulate(
    app: App,
    *,
    robots: int | None = None,
    topology: str | Path | None = None,
    values: Mapping[str, Any] | None = None,
    latency: float | str = 0.03,
    faults: Sequence[str] = (),
    seed: int = 1,
    iterations: int | None = None,
    seconds: float | None = None,
    check: bool = True,
    devices: bool = False,
    progress: bool = True,
    **options: Any,
) -> RunData:
    """Run an app on a simulated swarm in virtual time, as `swarm sim APP --virtual` does, and return the run.

    `app`: the class, the path of its file, or the name of a built-in app. The robots are r0, r1..., six by default;
    `topology` is line (the default), loop, full, thesis-d, random:SEED, auto or a matrix file. The option `config`
    names both itself. `values` are first values of the state and parameters: for all robots, as a list with one for
    each, or by robot (`{"x": {"r2": 3.0}}`). `latency` of the links: s, one way, or a text such as "30ms". `faults`
    are written as on the command line, with times in s after the first iteration: "cut r0-r1@1s,2s",
    "kill r2.app@5s", "off r3@5s,10s", "press r0.A@2s", "push r1@5s,0.2". The seed may draw robots and times, as in
    "off any@2s..8s,10s".

    The run ends after `iterations` (100 if neither is given), or after `seconds` of virtual time. `devices`: record
    poses, tilt and links, too, as `swarm sim --record` does; that takes three times as long. `options` are all other
    options of `swarm sim`, with _ for -: `jitter=0.01`, `loss=0.05`, `algorithm="thesis"`, `absent="drop"`.

    The same arguments give the same run to the bit. Raises `AppError` for an app that cannot be run and, with `check`,
    for a run with problems (else they are `run.problems`); `ConfigError` for a wrong argument. Of a run that has not
    converged, as `until` asks, it warns."""
    found = app_of(app)
    words = arguments_of(robots, topology, latency, faults, iterations, seconds, options)
    words += ["--seed", str(seed), "--virtual"]
    read = parse([found.name, *words], ends=False)
    settings = settings_for(found, values, robots, options)
    held = tempfile.mkdtemp(prefix="swarm-run-")
    place = Path(held) / "run"
    read = replace(read, settings=tuple(AppSetting("", each) for each in settings), record=place)
    topics = [topic for topic in TOPICS if devices or topic not in DEVICES]
    try:
        plan = build(read, PLACE, found)
        with shown_progress(f"{found.name}: {len(plan.config.names)} robots", shown=progress) as look:
            VirtualRun(read, plan, topics=topics, look=look, said=partial(say, sys.stdout)).go()
        sets = [f"--set={each.text}" for each in settings]
        keep_command(place, [found.name if found.is_built_in else f"{found.name}.py", *words, *sets])
        run = RunData(place)
    except BaseException:
        shutil.rmtree(held)
        raise
    weakref.finalize(run.recording, shutil.rmtree, held, ignore_errors=True)
    unmet = [each for each in run.problems if is_unmet(each)]
    if check and len(run.problems) > len(unmet):
        raise AppError("; ".join([*run.problems, *forgetting(plan.config, found, read)]))
    for each in unmet:
        warnings.warn(f"simulate: {each}", stacklevel=2)
    return run


def app_of(app: App) -> loader.LoadedApp:
    """Return the app that a program means. Raises `AppError`."""
    return loader.load(str(app)) if isinstance(app, str | Path) else loader.of_class(app)


def settings_for(
    app: loader.LoadedApp, values: Mapping[str, Any] | None, robots: int | None, options: Mapping[str, Any]
) -> list[Setting]:
    """Return first values and parameters as settings. Raises `ConfigError`."""
    if values is not None and not isinstance(values, Mapping):
        raise ConfigError(f'values: expected them by name, such as {{"x": [1.0, 2.0]}}, got {shown(values)}')
    choice = options.get("algorithm") or (values or {}).get("algorithm")
    kind, _ = app.choose({"algorithm": choice} if isinstance(choice, str) else {})
    names = [f"r{index}" for index in range(ROBOTS if robots is None else robots)]
    if options.get("config") is not None:
        names = list(configuration.load(Path(options["config"]), addressed=False).names)
    return settings_from_values(kind, values or {}, names)


def flags_of_options() -> dict[str, str]:
    """Return the options of `swarm sim` that are `**options` of `simulate`, by their names there."""
    flags = {}
    for each in (action for action in parser()._actions if action.dest not in ELSEWHERE):
        name = each.option_strings[0].removeprefix("--").replace("-", "_")
        flags["run_for" if name == "for" else name] = each.option_strings[0]  # `for` is a word of Python
    return flags


def arguments_of(
    robots: int | None,
    topology: str | Path | None,
    latency: float | str,
    faults: Sequence[str],
    iterations: int | None,
    seconds: float | None,
    options: Mapping[str, Any],
) -> list[str]:
    """Return the command line of `swarm sim` with the same meaning. Raises `ConfigError`."""
    flags = flags_of_options()
    words = [f"--latency={latency}"]
    if options.get("config") is None:
        robots = ROBOTS if robots is None else robots
        topology = "line" if topology is None else topology
    if robots is not None and not isinstance(robots, Integral):  # numpy's integers are integral numbers
        raise ConfigError(f"robots: expected a whole number, got {shown(robots)}")
    if not isinstance(topology, str | Path | None):
        raise ConfigError(
            "topology: expected a name, such as loop, or the path of a file with an adjacency matrix, which "
            'numpy.savetxt("graph.txt", matrix, fmt="%d") writes'
        )
    for name, value in (("robots", robots), ("topology", topology), ("iterations", iterations), ("seconds", seconds)):
        words += [] if value is None else [f"--{name}={value}"]
    if isinstance(faults, str) or not isinstance(faults, Sequence) or not all(isinstance(it, str) for it in faults):
        raise ConfigError(f"faults: expected a list of texts, got {shown(faults)}")
    for fault in faults:
        kind, _, text = fault.partition(" ")
        if kind not in EVENTS or not text:
            raise ConfigError(f'{fault!r} is no fault such as "cut r0-r1@1s,2s"; there are {", ".join(EVENTS)}')
        words.append(f"--{kind}={text.strip()}")
    for name, value in options.items():
        if name not in flags:
            raise ConfigError(f"there is no option {name!r}; beside its own simulate has {', '.join(sorted(flags))}")
        if value is not None:
            text = ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
            words.append(f"{flags[name]}={text}")
    return words
