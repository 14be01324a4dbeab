"""The claim that makes an app run in one process on each robot (rule R6): a lock file, and a number that goes up with
every start.

The kernel drops the lock when the process ends, however it ends. The number in the file is the incarnation:
neighbours ignore frames of a lower one, so that what a dead process left on the way does no harm.
"""

import os
from pathlib import Path

from swarm.errors import LocalError
from swarm.process.locks import take_lock

_DIGITS = 20  # of 2**64; a fixed width is overwritten by one small write, which a kill does not tear


class AppLock:
    """Holds `RUNTIME/app.<name>.lock` until closed."""

    def __init__(self, runtime: Path, app: str) -> None:
        """Raises `LocalError` where another process has it, or the directory cannot be used."""
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
            self.incarnation = int(text or b"0") + 1
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
