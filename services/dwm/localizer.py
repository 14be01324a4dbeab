"""The common part of all live sources of a module's answers: pipeline, odometry from the balancer, messages on the
bus."""

from collections import deque
from logging import INFO, WARNING
from pathlib import Path
from typing import Protocol

from services.dwm.core.calibration import calibration_file
from services.dwm.core.calibration.models import Calibration, RangeModel
from services.dwm.core.estimation.motion import Increments
from services.dwm.core.estimation.pipeline import Pipeline
from services.dwm.core.module.diagnosis import DiagnosisWatch
from services.dwm.core.module.tlv import Location
from swarm.config import Config
from swarm.errors import ConfigError
from swarm.messages import Odometry
from swarm.messages.keys import key
from swarm.process.runtime import Outlets, listen

_MAX_WAITING = 250
"""Odometry messages that wait for a report of the module: ten seconds of them. Then the oldest go."""


def calibration_path(config: Config, robot: str) -> Path | None:
    """Return the calibration file of `robot`; None where the config names none."""
    if config.dwm.calibration is None:
        return None
    return config.path.parent / config.dwm.calibration.replace("{robot}", robot)


def load_calibration(config: Config, robot: str) -> Calibration:
    """Return the models in force for `robot`: of its file, else of swarm.toml. Raises `ConfigError`.

    A file that is not there is no error: a new robot has none, and works less exactly until it has (`uncalibrated`).
    """
    normal = Calibration(RangeModel.of(config.dwm.distance), config.dwm.position)
    path = calibration_path(config, robot)
    if path is None:
        return normal
    try:
        text = path.read_text("utf-8")
    except FileNotFoundError:
        return normal
    except OSError as error:
        raise ConfigError(f"{path}: the calibration of {robot} cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is no text") from None
    file = calibration_file.parse(text, str(path))
    calibration_file.check(file, str(path), robot, config.anchors)
    return file.over(normal)


def uncalibrated(config: Config, robot: str) -> str | None:
    """Return a warning where the config names a calibration that `robot` does not have; None where it has it."""
    path = calibration_path(config, robot)
    if path is None or path.exists():
        return None
    return (
        f"there is no calibration {path}: ranges and places are corrected as [dwm] says only; make one by "
        f"swarm calibrate distance --robots {robot}, and bring it by swarm deploy"
    )


def known_modules(config: Config) -> dict[str, str]:
    """Return what the modules besides the anchors are, by address."""
    known = dict(config.robots_by_module)
    if config.dwm.target is not None:
        known.setdefault(config.dwm.target, "target")
    return known


class _Host(Outlets, Protocol):
    """The part of a service that is used here: `swarm.process.service.Service` in a process."""

    config: Config
    robot: str


class Localizer:
    """Turns a module's answers into `dwm/ranges` and `dwm/pose`."""

    def __init__(self, service: _Host, now: float, *, external: bool = False) -> None:
        """`external`: the answers are no module's (see `Pipeline`). Raises `ConfigError` where the robot's calibration
        does not fit."""
        config, robot = service.config, service.robot
        self._service = service
        if problem := uncalibrated(config, robot):
            service.log.warning("%s", problem)
        kind = config.dwm.filter_of(robot)
        self._pipeline = Pipeline(
            config.dwm,
            config.robots_by_module,
            kind=kind,
            calibration=load_calibration(config, robot),
            anchors=config.anchors,
            external=external,
        )
        # An anchor ranges to nobody, so its answers say nothing.
        is_tag = config.robot(robot).uwb_role == "tag"
        self._watch = DiagnosisWatch(config.anchors, known_modules(config), now) if is_tag else None
        self._odometry: deque[Odometry] = deque(maxlen=_MAX_WAITING)
        self._increments = Increments()
        if kind in ("auto", "ekf"):
            listen(service, key(robot, "balancer", "odometry"), Odometry, self._odometry.append)

    def report(self, location: Location, when: float) -> None:
        """Publish what follows from an answer that the module gave at `when`, and from the odometry heard so far."""
        self._move()
        ranges, pose = self._pipeline.report(location, when)
        service = self._service
        service.counters["reports"] += 1
        for finding in self._watch.report(location, when) if self._watch else ():
            level = WARNING if finding.fatal else INFO
            service.log.log(level, "%s: %s; %s", finding.code, finding.text, finding.remedy)
        service.counters.update(self._pipeline.dropped())
        service.counters["filter_restarts"] = self._pipeline.tracker.restarts
        service.bus.publish(key(service.robot, "dwm", "ranges"), ranges)
        service.bus.publish(key(service.robot, "dwm", "pose"), pose)

    def _move(self) -> None:
        """Give the filter the motion since the last report."""
        tracker = self._pipeline.tracker
        while self._odometry:
            message = self._odometry.popleft()
            motion = self._increments.take(message)
            if motion is None:
                tracker.begin(message.t)
            else:
                tracker.odometry(*motion)
