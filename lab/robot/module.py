"""In a machine of the lab: the simulated DWM1001 of this robot, at its place of the config."""

import shutil
from pathlib import Path

from sim.core.module_line import TTY
from sim.devices.module import ModuleBoard
from swarm.config import Config

POLL_S = 1.0


def board(config: Config, robot: str, run_dir: Path, user: str) -> ModuleBoard:
    """The module. The pseudo-terminal RUN_DIR/ROBOT/dwm.tty belongs to `user`, as udev gives the real one."""
    # What errs, errs otherwise on every robot.
    made = ModuleBoard(run_dir, config, config.names.index(robot))
    made.add(robot)
    shutil.chown((run_dir / robot / TTY).resolve(), user)
    return made


def serve(made: ModuleBoard) -> None:
    """Serve, until the machine goes off."""
    while True:
        made.poll(POLL_S)
