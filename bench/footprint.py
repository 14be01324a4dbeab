"""Proportional memory of one robot running alone: bus, mesh, balancer, dwm, one app."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from bench.rows import Row
from services.sim import footprint, options, scenario
from services.sim.module import ModuleBoard
from services.sim.processes import Processes
from services.sim.run import APP_SERVICE, SERVICE_MODULES
from swarm import clock
from swarm.config.dump import dump

LIMIT_MIB = 130.0
"""Of the 512 MB of a Pi Zero 2 W, which keeps 64 for its GPU and about as much for kernel and system."""

SHARE_MIB = LIMIT_MIB / (len(SERVICE_MODULES) + 1)
"""What one service may take where all take the same."""

SETTLE_S = 5.0
"""After it all services are up and have done their work some dozen times."""


def rows() -> Iterator[Row]:
    """Start one robot without the simulation's own process, which would share its pages, and look."""
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
        for service, module in SERVICE_MODULES.items():
            processes.add(robot, service, [module], run_dir / robot)
        processes.add(robot, "app/localization", [APP_SERVICE, "localization"], run_dir / robot)
        settled = clock.now() + SETTLE_S
        while clock.now() < settled:
            modules.poll(0.05)
        total = 0.0
        for child in processes.children:
            memory = footprint.proportional_mib(child)
            total += memory
            yield Row(f"{child.service}, proportional memory", memory, "MiB", SHARE_MIB, 1.5)
        yield Row("one robot alone, proportional memory", total, "MiB", LIMIT_MIB, 1.0)
