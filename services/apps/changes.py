"""An app's parameters on the bus: told, and changed by request while the app runs.

A changed value holds for the run: a process that is started again in mid-run takes up what was changed.
"""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from swarm import clock
from swarm.app.sync_app import App
from swarm.bus.protocol import BusLike, Clock
from swarm.errors import AppError, PayloadError
from swarm.files import atomic_write
from swarm.frozen import frozen
from swarm.messages import AppParameter, AppParameters, AppParametersSet, SetAppParameters
from swarm.messages.codec import Value, decode, encode
from swarm.messages.keys import key
from swarm.process.paths import VOLATILE


class Refuse(Protocol):
    """What is told of requests that are none."""

    def __call__(self, error: PayloadError) -> None:
        """`error` names key and field."""


@frozen
class _Kept:
    run: int
    parameters: dict[str, Value]


_log = logging.getLogger("changes")


class Changes:
    """Answers for one app on one robot."""

    def __init__(
        self,
        bus: BusLike,
        robot: str,
        name: str,
        app: App,
        change: Callable[[Mapping[str, Value]], None],
        refuse: Refuse,
        now: Clock = clock.now,
        *,
        kept: tuple[Path, int] | None = None,
        record: Callable[[AppParameters], None] | None = None,
    ) -> None:
        """`change(values)` takes new values or raises `AppError`; it runs on the bus's thread. `kept`: the file that
        keeps them, and the run they hold for. `record`: is given them where they are told."""
        self._record = record
        self._file = kept
        self._kept = self._read()
        self._bus = bus
        self._robot = robot
        self._name = name
        self._app = app
        self._change = change
        self._refuse = refuse
        self._now = now
        self._key = key(robot, f"app/{name}", "parameters")
        bus.serve(self._key, lambda *_: encode(self._message()))
        bus.subscribe(key(robot, f"app/{name}", "set", "parameters"), self._on_set)

    def kept(self) -> dict[str, Value]:
        """What an earlier process of this run was told; without what the app's file no longer takes."""
        found: dict[str, Value] = {}
        for name, value in self._kept.items():
            try:
                found |= type(self._app).check_change({name: value})
            except AppError as error:
                _log.warning("app %s: what was changed before is not taken up: %s", self._name, error)
        return found

    def tell(self) -> None:
        """Publish the parameters as they are now: at the start, and after a change."""
        message = self._message()
        self._bus.publish(self._key, message)
        if self._record is not None:
            self._record(message)

    def _message(self) -> AppParameters:
        return in_force(self._app, self._now())

    def _on_set(self, name: str, payload: bytes) -> None:
        try:
            request = decode(SetAppParameters, payload, name)
        except PayloadError as error:
            self._refuse(error)
            return
        problem = ""
        try:
            self._change(request.parameters)
            self._keep(request.parameters)
        except AppError as error:
            problem = f"app {self._name} on {self._robot}: {error}"
        answer = AppParametersSet(self._now(), request.ticket, problem)
        self._bus.publish(key(self._robot, f"app/{self._name}", "parameters_set"), answer)

    def _keep(self, values: Mapping[str, Value]) -> None:
        self._kept = {**self._kept, **values}
        if self._file is None:
            return
        path, run = self._file
        try:
            atomic_write(path, encode(_Kept(run, self._kept)), unsynced=VOLATILE)
        except OSError as error:
            _log.warning("%s: %s; a restart will not know what was changed", path, error.strerror)

    def _read(self) -> dict[str, Value]:
        if self._file is None:
            return {}
        path, run = self._file
        try:
            kept = decode(_Kept, path.read_bytes(), str(path))
        except FileNotFoundError:
            return {}
        except (OSError, PayloadError) as error:
            _log.warning("%s; what was changed while the app ran is forgotten", error)
            return {}
        return kept.parameters if kept.run == run else {}


def in_force(app: App, now: float) -> AppParameters:
    """An app's parameters as they are now, and what they may be."""
    told = app.told_parameters()
    return AppParameters(
        now,
        {
            name: AppParameter(value, declared.unit, declared.expected(), bool(declared.live))
            for name, (declared, value) in told.items()
        },
    )
