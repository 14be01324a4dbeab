"""Asks the robot's apt what it would install from a bundle, of which only the index has to be there."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swarm.files import atomic_write
from swarm.onboard.bootstrap.commands import run

_ANEW = "each question to apt begins by writing these files"


def main(request: dict[str, Any], tell: Callable[[object], None]) -> dict[str, Any]:
    """Ask apt. The request has folder, index (text of Packages), apt (command line up to the names) and packages.

    The answer has `install` (name and version of each), `there` (SHA-256 of files that are there whole), `problem`.
    """
    folder = Path(request["folder"])
    debs = folder / "debs"
    for path in (debs, folder / "lists/partial", folder / "apt/archives/partial"):
        path.mkdir(parents=True, exist_ok=True)
    index = request["index"].encode()
    checksum = hashlib.sha256(index).hexdigest()
    atomic_write(debs / "Packages", index, unsynced=_ANEW)
    # apt compares the index with this; the packages are compared with the index.
    release = f"Suite: balboa-swarm\nSHA256:\n {checksum} {len(index)} Packages\n"
    atomic_write(debs / "Release", release.encode(), unsynced=_ANEW)
    atomic_write(folder / "sources.list", f"deb [trusted=yes] file:{debs} ./\n".encode(), unsynced=_ANEW)
    code, out, err = run(*request["apt"], "update", seconds=120)
    if code == 0:
        code, out, err = run(*request["apt"], "--simulate", "install", *request["packages"], seconds=120)
    if code != 0:
        return {"install": [], "there": [], "problem": _reason(out + err)}
    install = re.findall(r"^Inst (\S+) (?:\[[^\]]*\] )?\((\S+) ", out, re.M)
    there = [hashlib.sha256(path.read_bytes()).hexdigest() for path in debs.glob("*.deb")]
    return {"install": install, "there": there, "problem": ""}


def _reason(said: str) -> str:
    """Return apt's reason for a failure: its errors, and the dependencies that it names before them."""
    lines = [line.strip() for line in said.splitlines()]
    depends = [line for line in lines if "Depends:" in line and "but" in line]
    errors = [line[2:].strip() for line in lines if line.startswith("E:")]
    return "; ".join([*depends[:2], *errors[:1]])[:300] or "apt-get failed without a word"
