"""Proportional memory of one robot running alone: bus, mesh, balancer, dwm, one app."""

import contextlib
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from bench.rows import Row
from sim.devices.module import ModuleBoard
from sim.processes import footprint
from sim.processes.processes import Processes
from sim.processes.run import APP_SERVICE, SERVICE_MODULES
from sim.scenario import options, scenario
from swarm import clock
from swarm.config.dump import dump

LIMIT_MIB = 130.0
"""Of the 512 MB of a Pi Zero 2 W, which keeps 64 for its GPU and about as much for kernel and system."""

SHARE_MIB = LIMIT_MIB / (len(SERVICE_MODULES) + 1)
"""What one service may take where all take the same."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    settle_s: float = 5.0
    """After it all services are up and have done their work some dozen times."""


FULL = Sizes()
SMOKE = Sizes(2.0)


@contextlib.contextmanager
def robot_alone(services: Mapping[str, str], settle_s: float) -> Iterator[dict[str, float]]:
    """One robot with these services (module and first argument by name), settled: proportional memory of each, MiB.

    Without the simulation's own process, which would share its pages.
    """
    with tempfile.TemporaryDirectory(prefix="swarm-bench-") as name, contextlib.ExitStack() as stack:
        run_dir = Path(name)
        plan = scenario.build(options.parse(["localization", "--robots", "1", "--seconds", "60"]), run_dir)
        robot = plan.config.names[0]
        (run_dir / robot).mkdir()
        (run_dir / "swarm.toml").write_text(dump(plan.config))
        modules = ModuleBoard(run_dir, plan.config, seed=1)
        stack.callback(modules.close)
        modules.add(robot)
        processes = Processes({"SWARM_CONFIG": str(run_dir / "swarm.toml"), "SWARM_SIM_LINK": "latency=0.03"})
        stack.callback(processes.stop)
        for service, command in services.items():
            processes.add(robot, service, command.split(), run_dir / robot)
        settled = clock.now() + settle_s
        while clock.now() < settled:
            modules.poll(0.05)
        yield {child.service: footprint.proportional_mib(child) for child in processes.children}


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """All services and an app."""
    services = SERVICE_MODULES | {"app/localization": f"{APP_SERVICE} localization"}
    with robot_alone(services, sizes.settle_s) as memory:
        for service, mib in memory.items():
            yield Row(f"{service}, proportional memory", mib, "MiB", SHARE_MIB, 1.5)
        yield Row("one robot alone, proportional memory", sum(memory.values()), "MiB", LIMIT_MIB, 1.0)
