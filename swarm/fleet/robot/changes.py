"""Carries out changes on a robot, in order, until one fails; each file is whole or as it was.

A change is a map with `do`:
    write   path, text, mode ("0644"): the file holds this text; beside it first, then renamed
    link    path, to: a symbolic link
    run     words, seconds: a command that must end with 0
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swarm.fleet.robot.commands import below, run


class ChangeError(Exception):
    """A command did not do it."""


def main(request: dict[str, Any], tell: Callable[[object], None]) -> dict[str, Any]:
    """Request: `steps`, pairs of a name and its changes. `problem` says why one failed (else empty), `step` which."""
    for step, changes in request["steps"]:
        try:
            for change in changes:
                _CHANGES[change["do"]](request.get("root", "/"), change)
        except (ChangeError, OSError) as error:
            return {"step": step, "problem": str(error)}
    return {"step": "", "problem": ""}


def _beside(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(path.name + ".swarm-new")
    with contextlib.suppress(FileNotFoundError):
        new.unlink()
    return new


def _write(root: str, change: dict[str, Any]) -> None:
    path = below(root, change["path"])
    new = _beside(path)
    try:
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(change["text"].encode())
            file.flush()
            # /boot/firmware is FAT: it has no modes, and refuses to set them.
            with contextlib.suppress(PermissionError):
                os.fchmod(descriptor, int(change.get("mode", "0644"), 8))
            os.fsync(descriptor)
        new.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _link(root: str, change: dict[str, Any]) -> None:
    path = below(root, change["path"])
    new = _beside(path)
    new.symlink_to(change["to"])
    new.replace(path)


def _run(root: str, change: dict[str, Any]) -> None:
    code, out, err = run(*change["words"], seconds=change.get("seconds", 60.0))
    if code != 0:
        lines = [line.strip() for line in (out + "\n" + err).splitlines() if line.strip()]
        # apt and dpkg say what is wrong in lines that begin so, and then much more.
        errors = [line for line in lines if line.startswith(("E:", "dpkg: error"))]
        said = (errors or lines or [f"exit code {code}"])[-1]
        raise ChangeError(f"{' '.join(change['words'][:3])}: {said[:300]}")


_CHANGES = {"write": _write, "link": _link, "run": _run}
