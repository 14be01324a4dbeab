"""The facts about a robot for provisioning: read only, as root. A missing fact is no error."""

from __future__ import annotations

import contextlib
import os
import platform
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swarm.onboard.bootstrap.commands import below, line, run, text, unit

PLACES = {
    "model": "/proc/device-tree/model",
    "kernel": "/proc/sys/kernel/osrelease",
    "boot_id": "/proc/sys/kernel/random/boot_id",
    "modules": "/lib/modules",
}
"""The files in which the kernel describes itself and the board. A request may name others."""


def main(request: dict[str, Any], tell: Callable[[object], None]) -> dict[str, Any]:
    """Return the facts; the request names files, links, packages and units to look at."""
    root = request.get("root", "/")
    places = {name: below(root, path) for name, path in {**PLACES, **request.get("places", {})}.items()}
    release = (text(below(root, "/etc/os-release")) or "").splitlines()
    return {
        "model": line(places["model"]),
        "machine": platform.machine(),
        "architecture": run("dpkg", "--print-architecture")[1].strip(),
        "os": {name: value.strip('"') for name, equals, value in (each.partition("=") for each in release) if equals},
        "python": "{}.{}".format(*sys.version_info[:2]),
        "kernel": line(places["kernel"]),
        "kernels": sorted(path.name for path in places["modules"].glob("*")),
        "boot_id": line(places["boot_id"]),
        "time": time.time(),
        "free": {path: _free(root, path) for path in request.get("disks", ())},
        "files": {path: text(below(root, path)) for path in request.get("files", ())},
        "modes": {path: _mode(root, path) for path in request.get("files", ())},
        "links": {path: _link(root, path) for path in request.get("links", ())},
        "there": [path for path in request.get("there", ()) if below(root, path).exists()],
        "packages": _packages(request.get("packages", ())),
        "broken": _broken(),
        "units": {name: unit(name, "LoadState,ActiveState,UnitFileState") for name in request.get("units", ())},
        "hostname": socket.gethostname() if root == "/" else line(below(root, "/etc/hostname")),
        "blocked": _blocked(root),
        "current": (_link(root, "/opt/swarm/current") or "").rpartition("/")[2],
    }


def key_facts(path: Path) -> dict[str, Any] | None:
    """Return mode, owner and ids of the keys in a file, None where there is none. Ids are no secret, as keys are."""
    try:
        state = path.stat()
    except OSError:
        return None
    rows = [row.partition("#")[0].split() for row in (text(path) or "").splitlines()]
    ids = [row[0] for row in rows if len(row) == 2]
    return {"mode": f"{state.st_mode & 0o7777:04o}", "owner": _owner(path, state.st_uid), "ids": ids}


def _owner(path: Path, number: int) -> str:
    """Return the name of a file's owner, or the number where nobody has it."""
    try:
        return path.owner()
    except KeyError:
        return str(number)


def _free(root: str, path: str) -> int | None:
    """Return the bytes that may still be written to a path."""
    try:
        disk = os.statvfs(below(root, path))
    except OSError:
        return None
    return disk.f_bavail * disk.f_frsize


def _mode(root: str, path: str) -> str | None:
    with contextlib.suppress(OSError):
        return f"{below(root, path).stat().st_mode & 0o7777:04o}"
    return None


def _link(root: str, path: str) -> str | None:
    """Return the target of a symbolic link, "" for a plain file, None where the file or the target is missing."""
    place = below(root, path)
    if not place.exists():
        return None
    return str(place.readlink()) if place.is_symlink() else ""


def _packages(names: list[str]) -> dict[str, str]:
    """Return the versions of the packages that are installed whole."""
    found = {}
    for name in names:
        code, out, _ = run("dpkg-query", "--show", "--showformat=${db:Status-Abbrev}|${Version}", name)
        state, _, version = out.partition("|")
        if code == 0 and state.strip() == "ii":
            found[name] = version
    return found


def _broken() -> str:
    """Return the packages that were left in the middle of their installation."""
    return " ".join(row.split()[0] for row in run("dpkg", "--audit")[1].splitlines() if row.startswith(" "))


def _blocked(root: str) -> list[str]:
    """Return the radios that are switched off: `bluetooth` or `wlan` (soft), the same with `!` where it is by a real
    switch."""
    found = []
    for folder in sorted(below(root, "/sys/class/rfkill").glob("*")):
        if line(folder / "hard") == "1":
            found.append(line(folder / "type") + "!")
        elif line(folder / "soft") == "1":
            found.append(line(folder / "type"))
    return found
