"""Calibrations between this computer and the robots: what `swarm deploy` brings and `swarm fetch` takes back.

Here and on a robot the file is `calibration/ROBOT.toml` beside `swarm.toml`.
"""

import shlex
from collections.abc import Mapping
from pathlib import Path

from laptop.fleet.ssh.ssh import Host, HostError, Ssh
from services.dwm.core.calibration import calibration_file
from services.dwm.localizer import calibration_path
from swarm.config import Config
from swarm.errors import ConfigError, LocalError
from swarm.files import atomic_write, make_folder

SETTING = "calibration/{robot}.toml"
"""The value of `[dwm] calibration` on robots."""

_THERE = "/etc/swarm/calibration/{robot}.toml"


def with_calibration(files: Mapping[str, bytes], config: Config, robot: str) -> dict[str, bytes]:
    """Return the files that go with a release to one robot: `files` and its calibration, where there is one here.

    Raises `LocalError` where its dwm service would refuse the file.
    """
    path = calibration_path(config, robot)
    if path is None or not path.exists():
        return dict(files)
    if config.dwm.calibration != SETTING:
        raise LocalError(
            f'{config.path}: robots have their calibrations at [dwm] calibration = "{SETTING}"; put it there'
        )
    try:
        data = path.read_bytes()
        file = calibration_file.parse(data.decode(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise LocalError(f"{path} cannot be read: {error}") from None
    calibration_file.check(file, str(path), robot, config.anchors)
    return {**files, "calibration": data}


async def bring_back(ssh: Ssh, host: Host, config: Config) -> str:
    """Take a robot's calibration where it is newer than the one here, which is kept as NAME~.

    Returns in words what came of it; empty where the robot has none, or the same.
    """
    path = calibration_path(config, host.robot)
    place = shlex.quote(_THERE.format(robot=host.robot))
    data = (await ssh.check(host, f"sudo -n cat {place} 2>/dev/null || true")).encode()
    if not data or path is None:
        return ""
    try:
        theirs = calibration_file.parse(data.decode(), f"its {place}")
    except ConfigError as error:
        raise HostError(str(error)) from None
    try:
        return _take(path, data, theirs)
    except OSError as error:
        raise HostError(f"{path}: {error.strerror}") from None


def _take(path: Path, data: bytes, theirs: calibration_file.CalibrationFile) -> str:
    """Write a robot's calibration to `path` where it is newer; returns what `bring_back` does. Raises `OSError`."""
    if path.exists():
        before = path.read_bytes()
        if before == data:
            return ""
        try:
            ours = calibration_file.parse(before.decode(errors="replace"), str(path))
        except ConfigError:
            ours = None
        if ours is not None and _made(ours) >= _made(theirs):
            return f"its calibration is older than {path}: swarm deploy brings yours"
        atomic_write(path.with_name(path.name + "~"), before)
    make_folder(path.parent)
    atomic_write(path, data)
    return f"calibration: {path}"


def _made(file: calibration_file.CalibrationFile) -> str:
    """Return when its newest part was made, UTC in ISO 8601: earlier ones sort first."""
    return max((part[1].made for part in (file.distance, file.position) if part is not None), default="")
