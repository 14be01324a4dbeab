"""Releases to deploy, and ssh servers that look like robots with one."""

import hashlib
import io
import os
import tarfile
from pathlib import Path

from fake_robots import FakeRobots

from laptop.fleet.release import release

INSTALL = """#!/bin/sh
echo "$@" >> $HOME/installed
cat "$4" > $HOME/config
echo "install: $(cat ID) runs as $2"
"""


def make_release(path: Path, identity: str, wheels: dict[str, bytes], install: str = INSTALL) -> Path:
    machine, python = os.uname().machine, "3.11"
    files = {"ID": identity.encode(), "FOR": f"{machine} {python}".encode(), "install": install.encode(), **wheels}
    with tarfile.open(path, "w:gz") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(f"balboa-swarm-{identity}/{name}")
            entry.size, entry.mode = len(data), 0o755 if name == "install" else 0o644
            archive.addfile(entry, io.BytesIO(data))
    return path


def add_python(home: Path) -> None:
    python = home / "bin/python3.11"
    python.write_text("#!/bin/sh\n")
    python.chmod(0o755)


def make_package_cache(cache: Path) -> None:
    """Make a user's cache folder (`$XDG_CACHE_HOME`) with the packages of a release as an earlier one has left them, so
    that `swarm deploy` makes one without network."""
    lock = (release.PARTS / release.LOCK).read_text()
    key = hashlib.sha256("\n".join([os.uname().machine, "3.11", lock]).encode()).hexdigest()[:16]
    folder = cache / "balboa-swarm/wheels" / key
    folder.mkdir(parents=True)
    (folder / release.LOCK).write_text(lock)


def sent(outcome: dict[str, object]) -> int:
    return int(str(outcome["text"]).rpartition("(")[2].split()[0])


PATHS = "s#/etc/swarm#etc#g; s#/var/lib/swarm#lib#g"


def add_robot(
    robots: FakeRobots, name: str, release: str = "1-a", revision: int = 1, config: bytes = b"", own: str = ""
) -> Path:
    """A robot that says what it runs, with the system's folders in its home."""
    home = robots.add(name)
    (home / "etc/apps").mkdir(parents=True)
    (home / "lib/apps").mkdir(parents=True)
    (home / "config").write_bytes(config)
    robots.script(name, "sed", f'case $2 in s/^SWARM_ROBOT*) echo {own} ;; *) exec /usr/bin/sed "$@" ;; esac')
    robots.script(name, "readlink", f"echo /opt/swarm/releases/{release}")
    # The config of the others is the one here, which is complete when all robots are added.
    told = f"[ -s $HOME/config ] || exec /usr/bin/sha256sum {robots.config}; echo {'0' * 64}"
    robots.script(name, "sha256sum", f'case $1 in /etc/*) {told} ;; *) exec /usr/bin/sha256sum "$@" ;; esac')
    firmware = f'{{"key": "k", "value": {{"layout": 1, "revision": {revision}}}}}'
    text = f"shift; case $1 in */z_sub) echo '{firmware}' ;; "
    text += f'*) exec "$1" "$2" "$(printf \'%s\\n\' "$3" | sed \'{PATHS}\')" ;; esac'
    robots.script(name, "sudo", text)
    return home


def files(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in sorted(folder.rglob("*")) if path.is_file()}
