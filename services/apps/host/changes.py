"""An app's parameters on the bus: told, and changed by request while the app runs.

A changed value holds for the run: a process that is started again in mid-run takes up what was changed.
"""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

from services.apps.persistence import run_file
from swarm.app.sync_app import BaseApp
from swarm.errors import AppError
from swarm.frozen import frozen
from swarm.messages import AppParameter, AppParameters, AppParametersSet, SetAppParameters
from swarm.messages.codec import Value, encode
from swarm.messages.keys import key
from swarm.process.runtime import Runtime, listen


@frozen
class _Kept:
    run: int
    parameters: dict[str, Value]


_log = logging.getLogger("changes")


class Changes:
    """Answers for one app on one robot."""

    def __init__(
        self,
        runtime: Runtime,
        name: str,
        app: BaseApp,
        change: Callable[[Mapping[str, Value]], None],
        path: Path | None,
        run: int,
        record: Callable[[AppParameters], None] | None,
    ) -> None:
        """`change(values)` takes new values or raises `AppError`. `path`: the file that keeps them for run `run`, where
        they need to be kept. `record` is given them where they are told."""
        self._record = record
        self._path = path
        self._run = run
        self._kept = self._read()
        self._runtime = runtime
        self._bus = runtime.bus
        self._robot = runtime.robot
        self._name = name
        self._app = app
        self._change = change
        self._key = key(self._robot, f"app/{name}", "parameters")
        self._bus.serve(self._key, lambda *_: encode(self._message()))
        listen(runtime, key(self._robot, f"app/{name}", "set", "parameters"), SetAppParameters, self._on_set)

    def kept(self) -> dict[str, Value]:
        """Return the values that an earlier process of this run has accepted, without those that the app's file no
        longer has."""
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
        return in_force(self._app, self._runtime.now)

    def _on_set(self, request: SetAppParameters) -> None:
        problem = ""
        try:
            self._change(request.parameters)
            self._keep(request.parameters)
        except AppError as error:
            problem = f"app {self._name} on {self._robot}: {error}"
        answer = AppParametersSet(self._runtime.now, request.ticket, problem)
        self._bus.publish(key(self._robot, f"app/{self._name}", "parameters_set"), answer)

    def _keep(self, values: Mapping[str, Value]) -> None:
        self._kept = {**self._kept, **values}
        if self._path is None:
            return
        try:
            run_file.write(self._path, _Kept(self._run, self._kept))
        except OSError as error:
            _log.warning("%s: %s; a restart will not know what was changed", self._path, error.strerror)

    def _read(self) -> dict[str, Value]:
        if self._path is None:
            return {}
        kept = run_file.read(_Kept, self._path, self._run, "what was changed while the app ran is forgotten")
        return {} if kept is None else kept.parameters


def in_force(app: BaseApp, now: float) -> AppParameters:
    """Return an app's present parameters with their declarations."""
    told = app.told_parameters()
    return AppParameters(
        now,
        {
            name: AppParameter(
                *(value, declared.unit, declared.expected(), bool(declared.live)),
                kind=declared.kind.__name__,
                low=declared.low,
                high=declared.high,
                choices=declared.choices,
            )
            for name, (declared, value) in told.items()
        },
        app.layouts(),
    )
