"""In a machine of the lab, as root: what is soldered on a robot, until the machine goes off.

    python -m lab.robot RUN_DIR

SWARM_CONFIG, SWARM_ROBOT and SWARM_RUNTIME as for `sim.body`. LAB_FIRMWARE, where it is set, is a folder with
balboa.elf and libbench.so: then the firmware in the AVR simulator is the ATmega. RUN_DIR/orders is where faults of
the bus are ordered. systemd is notified when all parts are there. The module is a process of its own, forked from what
both have imported: imports are half of what a robot's boot takes.
"""

import os
import sys
from pathlib import Path

from lab.i2c import device
from lab.i2c.firmware import Chip
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
    device.serve(config, robot, str(run_dir / "orders"), firmware())


def firmware() -> Chip | None:
    """The ATmega as the AVR simulator has it, or none."""
    folder = os.environ.get("LAB_FIRMWARE")
    if folder is None:
        return None
    from avr_bench import Bench

    return Bench(Path(folder, "libbench.so"), Path(folder, "balboa.elf"))  # type: ignore[no-any-return]


if __name__ == "__main__":
    main()
