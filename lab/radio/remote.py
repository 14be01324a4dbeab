"""The radio process as tests use it."""

import contextlib
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

ROOT = Path(__file__).parents[2]


class RadioError(Exception):
    """The radio refused an order, or has gone."""


def address(number: int) -> str:
    """The Bluetooth address of the lab's robot with that number; the lowest dials."""
    return f"02:10:BA:00:00:{number + 1:02X}"


class Radio:
    """Starts the radio; its orders are those of `lab.radio.core.air.Air`. Leaving the `with` block ends it."""

    def __init__(self, folder: Path, robots: int, *, machines: bool) -> None:
        """`machines`: the adapters are for other machines, at `folder`/radio-N; otherwise for our own kernel."""
        self.addresses = [address(number) for number in range(robots)]
        self._path = folder / "radio-control"
        # A machine with six adapters has no time to write down what they say; elsewhere a failure can be looked into.
        traced = ["--trace", str(folder / "radio.btsnoop")]
        where = [*traced, "--sockets", str(folder)] if machines else ["--vhci"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lab.radio", "--control", str(self._path), *where, *self.addresses],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        )
        self.pid = self._process.pid
        assert self._process.stdout is not None
        if self._process.stdout.readline() != b"ready\n":
            raise RadioError("the radio did not start (see its error above)")
        self._own = folder / "radio-orders"
        self._own.unlink(missing_ok=True)
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sock.bind(str(self._own))
        self._sock.settimeout(30)

    def order(self, do: str, **details: Any) -> Any:
        """Have something done; what it came to. Raises RadioError."""
        self._sock.sendto(json.dumps({"do": do, **details}).encode(), str(self._path))
        answer = json.loads(self._sock.recv(65536))
        if "error" in answer:
            raise RadioError(answer["error"])
        return answer["result"]

    def close(self) -> None:
        """All adapters are unplugged."""
        self._sock.close()
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            self._process.communicate(timeout=60)
        self._process.kill()
        self._own.unlink(missing_ok=True)
        self._path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
