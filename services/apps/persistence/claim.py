"""The claim that makes an app run in one process on each robot (rule R6): a lock file, and a number that goes up with
every start.

The kernel drops the lock when the process ends, however it ends. The number in the file is the incarnation: neighbours
ignore frames of a lower one, so that what a dead process left on the way does no harm. The lock is in the runtime
directory, which a boot clears. So the number is also kept on the disk, and a boot does not set it back.
"""

import logging
import os
import time
from pathlib import Path

from swarm.errors import LocalError
from swarm.files import atomic_write, make_folder
from swarm.process.locks import take_lock

_log = logging.getLogger("app")

_MOST_STARTS = 10**15
"""Starts of an app, at most."""

_DIGITS = 20  # of 2**64; a fixed width is overwritten by one small write, which a kill does not tear


class AppLock:
    """Holds `RUNTIME/app.<name>.lock` until closed."""

    def __init__(self, runtime: Path, app: str, state: Path) -> None:
        """`state`: the directory that survives a reboot. Raises `LocalError` where another process has the lock, or the
        runtime directory cannot be used."""
        path = runtime / f"app.{app}.lock"
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o660)
        except OSError as error:
            raise LocalError(f"{path}: {error.strerror}; is the robot's bus running? (SWARM_RUNTIME)") from None
        try:
            take_lock(self._file)
            text = os.pread(self._file, _DIGITS, 0)
            if len(text) not in (0, _DIGITS):
                raise ValueError(f"the incarnation is cut short: {text!r}")  # noqa: TRY301 - the clause below names the file
            starts = state / "epochs" / f"{app}.starts"
            self.incarnation = max(int(text or b"0"), _kept(starts)) + 1
            _keep(starts, self.incarnation)
            os.pwrite(self._file, b"%0*d" % (_DIGITS, self.incarnation), 0)
        except BlockingIOError:
            os.close(self._file)
            raise LocalError(f"{path}: another process runs app {app} on this robot") from None
        except (OSError, ValueError) as error:
            os.close(self._file)
            raise LocalError(f"{path}: cannot be used: {error}") from None

    def close(self) -> None:
        """Let the next process have it."""
        os.close(self._file)


def _kept(path: Path) -> int:
    """Return the number that was kept on the disk. Where the file is damaged it is the time of day in seconds, which is
    above every number of starts."""
    try:
        with path.open("rb") as file:
            number = int(file.read(_DIGITS))
        problem = "" if 0 <= number <= _MOST_STARTS else f"{number} starts are not possible"
    except FileNotFoundError:
        return 0
    except (OSError, ValueError) as error:
        problem = str(error)
    if problem:
        _log.warning("%s: %s; the incarnation goes on with the time of day", path, problem)
        return int(time.time())
    return number


def _keep(path: Path, incarnation: int) -> None:
    data = b"%0*d" % (_DIGITS, incarnation)
    try:
        make_folder(path.parent)
        try:
            atomic_write(path, data)
        except OSError:  # on a full disk the old one's block is there
            with path.open("r+b") as file:
                file.write(data)
                os.fdatasync(file.fileno())
    except OSError as error:
        _log.warning("%s: %s; after a reboot neighbours may ignore this app for a while", path, error.strerror)
