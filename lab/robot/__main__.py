"""In a machine of the lab, as root: what is soldered on a robot, until the machine goes off.

    python -m lab.robot RUN_DIR

SWARM_CONFIG, SWARM_ROBOT and SWARM_RUNTIME as for `sim.body`. RUN_DIR/orders is where faults of the bus are
ordered. systemd is notified when all parts are there. The module is a process of its own, forked from what both have
imported: imports are half of what a robot's boot takes.
"""

import os
import sys
from pathlib import Path

from lab.i2c import device
from lab.robot import module
from swarm.config import load, who_am_i

MODULE_USER = "swarm-dwm"


def main() -> None:
    """Serve."""
    run_dir = Path(sys.argv[1])
    config = load()
    robot = who_am_i(config)
    board = module.board(config, robot, run_dir, MODULE_USER)
    if os.fork() == 0:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # the bus' priority is not its own
        module.serve(board)
    device.serve(config, robot, str(run_dir / "orders"))


if __name__ == "__main__":
    main()
