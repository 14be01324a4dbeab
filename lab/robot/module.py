"""In a machine of the lab: the simulated DWM1001 of this robot, at its place of the config.

    python -m lab.robot.module RUN_DIR USER

The pseudo-terminal RUN_DIR/ROBOT/dwm.tty belongs to USER, as udev gives the real one. systemd is notified when it is
there.
"""

import shutil
import sys
from pathlib import Path

from services.sim.core.module_line import TTY
from services.sim.module import ModuleBoard
from swarm.config import load, who_am_i
from swarm.process import notify

POLL_S = 1.0


def main() -> None:
    """Serve."""
    run_dir, user = Path(sys.argv[1]), sys.argv[2]
    config = load()
    robot = who_am_i(config)
    # What errs, errs otherwise on every robot.
    board = ModuleBoard(run_dir, config, config.names.index(robot))
    board.add(robot)
    shutil.chown((run_dir / robot / TTY).resolve(), user)
    notify("READY=1")
    while True:
        board.poll(POLL_S)


if __name__ == "__main__":
    main()
