"""What an app host records of its run: one MCAP file for each robot and app (docs/recordings.md)."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from swarm.codec import Value
from swarm.keys import key
from swarm.messages import AppProgress, AppState
from swarm.recording.file import RecordingFile
from swarm.recording.reader import EPOCH, RUN, SUFFIX


class Recorder:
    """The recording of one app on one robot. Losing it does not stop a run: it is logged once and counted."""

    def __init__(
        self,
        folder: Path,
        journal: Path,
        robot: str,
        app: str,
        counters: Counter[str],
        run: Mapping[str, str],
        *,
        append: bool,
    ) -> None:
        """`run`: what is to be known of the run as a whole, by name. `append`: go on with the file of an earlier
        process of this run; otherwise begin it anew."""
        self._prefix = key(robot, f"app/{app}")
        self._app = app
        self._file = RecordingFile(folder / f"{robot}.{app}{SUFFIX}", counters, append=append, journal=journal)
        self._file.metadata(RUN, {**run, "robot": robot, "app": app, EPOCH: str(self._file.epoch_ns)})

    def state(
        self, k: int, t: float, state: Mapping[str, Value], result: Mapping[str, Value], channel: str = ""
    ) -> None:
        """Record iteration k, reached at t; of one of the app's channels where it is named."""
        message = AppState(t, k, dict(state), dict(result))
        if channel:
            self._file.write(f"{self._prefix}/{channel}/state", t, message, f"{self._app}.{channel}.State")
        else:
            self._file.write(f"{self._prefix}/state", t, message, f"{self._app}.State")

    def value(self, t: float, name: str, value: object) -> None:
        """Record what the app's author wants kept (`robot.record`)."""
        self._file.write(f"{self._prefix}/record/{name}", t, {"t": t, "value": value}, f"{self._app}.{name}")

    def progress(self, progress: AppProgress) -> None:
        """Record that the app waits, goes on, is done or in fault."""
        self._file.write(f"{self._prefix}/progress", progress.t, progress)

    def flush(self) -> None:
        """Put into the file what was recorded so far. Waits for the disk."""
        self._file.flush()

    def close(self) -> None:
        """End the file."""
        self._file.close()
