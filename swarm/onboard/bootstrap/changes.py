"""Carries out changes on a robot, in order, until one fails; each file is whole or as it was. The answer comes when all
of it is on the disk.

A change is a map with `do`:
    write   path, text, mode ("0644"): the file holds this text; beside it first, then renamed
    link    path, to: a symbolic link
    run     words, seconds: a command that must end with 0
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from swarm.files import atomic_write, make_folder, sync_folder
from swarm.onboard.bootstrap.commands import below, run


class ChangeError(Exception):
    """A command failed."""


def main(request: dict[str, Any], tell: Callable[[object], None]) -> dict[str, Any]:
    """Carry out the `steps` of a request, pairs of a name and its changes. Return in `step` which one failed, and why
    in `problem`; both are empty without a failure."""
    try:
        return _carry_out(request)
    finally:
        os.sync()  # what commands write (systemctl, hostnamectl, apt) need not be on the disk when they end


def _carry_out(request: dict[str, Any]) -> dict[str, Any]:
    for step, changes in request["steps"]:
        try:
            for change in changes:
                _CHANGES[change["do"]](request.get("root", "/"), change)
        except (ChangeError, OSError) as error:
            return {"step": step, "problem": str(error)}
    return {"step": "", "problem": ""}


def _write(root: str, change: dict[str, Any]) -> None:
    path = below(root, change["path"])
    make_folder(path.parent)
    atomic_write(path, change["text"].encode(), mode=int(change.get("mode", "0644"), 8))


def _link(root: str, change: dict[str, Any]) -> None:
    path = below(root, change["path"])
    make_folder(path.parent)
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    new.symlink_to(change["to"])
    new.replace(path)
    sync_folder(path.parent)


def _run(root: str, change: dict[str, Any]) -> None:
    code, out, err = run(*change["words"], seconds=change.get("seconds", 60.0))
    if code != 0:
        lines = [line.strip() for line in (out + "\n" + err).splitlines() if line.strip()]
        # apt and dpkg say what is wrong in lines that begin so, and then much more.
        errors = [line for line in lines if line.startswith(("E:", "dpkg: error"))]
        said = (errors or lines or [f"exit code {code}"])[-1]
        raise ChangeError(f"{' '.join(change['words'][:3])}: {said[:300]}")


_CHANGES = {"write": _write, "link": _link, "run": _run}
