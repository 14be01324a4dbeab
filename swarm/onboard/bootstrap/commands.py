"""Commands and files of a robot, below a root folder that is `/` on a real one."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

NO_SUCH = 127


def run(*words: str, seconds: float = 60.0) -> tuple[int, str, str]:
    """Return exit code, output and complaints of a command. The code is 127 where there is no such command, and 124
    where the command did not end."""
    environment = {**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    try:
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, env=environment, check=False
        )
    except FileNotFoundError:
        return NO_SUCH, "", f"there is no {words[0]}"
    except subprocess.TimeoutExpired:
        return 124, "", f"{words[0]} did not end within {seconds:g} s"
    return done.returncode, done.stdout.decode(errors="replace"), done.stderr.decode(errors="replace")


def unit(name: str, properties: str) -> dict[str, str]:
    """Return properties of a unit of systemd; empty where there is no systemd."""
    _, out, _ = run("systemctl", "show", name, f"--property={properties}")
    return dict(row.split("=", 1) for row in out.splitlines() if "=" in row)


def below(root: str, path: str) -> Path:
    """Return a robot's `path` as a path here."""
    return Path(root) / path.lstrip("/")


def text(path: Path) -> str | None:
    """Return a file's text, of a large one the first MiB; None where it is missing or cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(1 << 20).decode(errors="replace")
    except OSError:
        return None


def line(path: Path) -> str:
    """Return a file's text without white space and zeros at its ends (a device tree's end in a zero); empty where it
    is missing."""
    return (text(path) or "").strip("\0\n ")
