"""The recording of an app's host: the folder of its run, and the file in it."""

import os
import time
from collections.abc import Sequence
from pathlib import Path

from services.apps import loader
from services.apps.persistence.recorder import Recorder, describe_fields
from swarm import clock
from swarm.app.settings import Setting
from swarm.config.dump import dump
from swarm.errors import RecordingError
from swarm.process.service import Service
from swarm.recording import folder
from swarm.recording.budget import Budget
from swarm.recording.file import UNRECORDED, RecordingFile, set_aside
from swarm.recording.reader import CLOCK, EPOCH, RUN, SUFFIX, run_of
from swarm.recording.recorded_topics import TopicRecorder

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
"""Names the machine's clock, which began when the machine did. Robots' services do not see it (ProcSubset of
systemd)."""


class AppRecording:
    """The recording of one app's process; a context. Losing it does not stop the app: it is logged once and counted."""

    def __init__(
        self,
        service: Service,
        app: loader.LoadedApp,
        run: int,
        seed: int,
        place: Path,
        settings: Sequence[Setting] = (),
    ) -> None:
        """`place`: the run's folder. A file of this run that an earlier process has left is gone on with. `settings`
        were above the configuration."""
        self._service = service
        self._told = ""
        entries = folder.describe(app.name, run, seed, app.digest)
        if settings:
            entries["set"] = " ".join(setting.text for setting in settings)
        # What was given on the command line stands in the file, so that it says all that the app was told.
        config = dump(service.config).encode() if settings else service.config.path.read_bytes()
        files = {folder.CONFIG_FILE: config}
        if not app.is_built_in:
            files[f"{app.name}.py"] = app.text
        try:
            folder.begin(place, entries, files)
        except OSError as error:
            service.log.warning("%s cannot be made, the run goes on: %s", place, error.strerror)
        path = place / f"{service.robot}.{app.name}{SUFFIX}"
        self._file = RecordingFile(
            path,
            service.counters,
            append=_goes_on(path, entries["run"]),
            journal=service.runtime / f"app.{app.name}.journal",
        )
        epoch_ns = self._file.epoch_ns
        own = {"robot": service.robot, EPOCH: str(epoch_ns), CLOCK: _clock(service.robot, epoch_ns)}
        self._file.metadata(RUN, entries | own)
        describe_fields(self._file, app.name, app.kind_on(service.config, service.robot))
        self._file.flush()  # whatever comes now: the next process finds which run this is of
        self.recorder = Recorder(self._file, service.robot, app.name)
        self.watch = TopicRecorder(service.bus, service.robot, app.name, self._file, clock.now)
        """What the robot's other services say meanwhile."""
        self.watch.on_lost = self._file.lose
        self._file.feed = self.watch.drain
        self._file.watched = self._tell
        if place.parent == folder.root():  # in a folder that somebody has named others' files are not ours
            budget = Budget(place.parent, service.config.recordings.budget, time.time)
            budget.keep()
            self._file.tidy = budget.keep

    def close(self) -> None:
        self._file.close()

    def _tell(self, problem: str) -> None:
        """Say in the service's status that nothing is recorded, and later that it is. A fault of the app stays."""
        status = self._service.status()
        told = f"{UNRECORDED}: {problem}; the run goes on"
        if problem and status.state == "ready":
            self._told = told
            self._service.degraded(told)
        elif not problem and status.state == "degraded" and status.reason == self._told:
            self._service.ready()


def _goes_on(path: Path, run: str) -> bool:
    """Return whether the file is of this run. A file that cannot be read may be, so it is set aside."""
    try:
        return path.stat().st_size > 0 and run_of(path) == run
    except FileNotFoundError:
        return False
    except (RecordingError, OSError) as error:
        try:
            set_aside(path, error)
        except OSError:
            return True  # it stays, and is not begun anew
        return False


def place_of(app: str, run: int, *, wanted: bool) -> Path | None:
    """Return the folder that SWARM_RECORD names, or the robot's own where a recording is `wanted`; None without
    either."""
    place = os.environ.get("SWARM_RECORD")
    if place:
        return Path(place)
    return folder.of_robot(app, run) if wanted else None


def _clock(robot: str, epoch_ns: int) -> str:
    """Return a name of this process' clock. Processes of one machine give the same name where it has a boot id."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return f"{robot}-{epoch_ns // 1_000_000_000}"
