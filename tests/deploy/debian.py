"""Debian systems to boot in containers, made once for each content of the archive and kept in the user's cache."""

import fcntl
import hashlib
import os
import subprocess
import urllib.request
from pathlib import Path

MIRROR = "http://deb.debian.org/debian"
INCLUDE = "systemd,systemd-sysv,dbus,udev,kmod,sudo,openssh-server,python3,python3-venv"


def unpack(suite: str, root: Path) -> None:
    """Make the folder `root` with a small Debian of this suite."""
    with urllib.request.urlopen(f"{MIRROR}/dists/{suite}/InRelease", timeout=60) as answer:
        digest = hashlib.sha256(answer.read() + INCLUDE.encode()).hexdigest()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "balboa-swarm-tests"
    cache.mkdir(parents=True, exist_ok=True)
    kept = cache / f"{suite}-{digest[:16]}.tar"
    # Tests in other processes may want the same one at the same time.
    with (cache / f"{suite}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            for old in cache.glob(f"{suite}-*.tar"):
                old.unlink()
            half = kept.with_suffix(".half.tar")
            command = ["mmdebstrap", "--quiet", "--variant=minbase", f"--include={INCLUDE}", suite, str(half), MIRROR]
            subprocess.run(command, check=True)
            half.rename(kept)
        root.mkdir()
        subprocess.run(["tar", "--extract", "--numeric-owner", f"--file={kept}", f"--directory={root}"], check=True)
