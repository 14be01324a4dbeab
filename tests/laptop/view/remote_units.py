"""A stand-in for systemd on a robot that is nothing but an ssh server: `systemctl` notes what it is told, and these
units are started, stopped, and started again when they die."""

import sys
import threading
import time
from pathlib import Path
from typing import Any

from conftest import Processes

SYSTEMCTL = """
case $1 in
show) if [ -e $HOME/active/$4 ]; then echo 7; else echo 0; fi ;;
*) echo "$@" >>$HOME/systemctl.log ;;
esac
"""

SUDO = """shift
case $1 in
*/bin/z_sub) echo '{{"key": "k", "value": {{"layout": 1, "revision": 1}}}}' ;;
*/bin/python) shift; echo $$ >>$HOME/started; SWARM_RUNTIME={runtime} exec {python} "$@" ;;
*/bin/swarm) shift; echo "$@" >>$HOME/swarm.log
    case $* in *=9) echo "parameter  r"; echo "app $3: expected a number up to 1, got 9"; exit 1 ;; esac ;;
sh) exec sh -c "$(printf '%s\\n' "$3" | sed "s#/etc/swarm#$HOME/etc#g; s#/var/lib/swarm#$HOME/lib#g")" ;;
*) exec "$@" ;;
esac
"""
"""What the robot's own folders are is in its home."""

_LOOK_S = 0.02

RESTART_S = 0.6
"""s until what has died runs again: RestartSec= of the units, and what Python takes to start where it is not forked."""


class Units:
    """Of one robot; apps, and services that a test names."""

    def __init__(self, home: Path, processes: Processes, environment: dict[str, str]) -> None:
        self._home = home
        self._processes = processes
        self._environment = environment
        self._running: dict[str, Any] = {}
        self._wanted: dict[str, bool] = {}
        self._died: dict[str, float] = {}
        self._read = 0
        for folder in ("active", "etc/apps", "lib/apps"):
            (home / folder).mkdir(parents=True)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def start(self, unit: str) -> None:
        """As if systemd had done it on boot."""
        self._wanted[unit] = True

    def close(self) -> None:
        """The processes are ended by whoever counts them."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing.wait(_LOOK_S):
            log = self._home / "systemctl.log"
            lines = log.read_text().splitlines() if log.exists() else []
            for line in lines[self._read :]:
                words = [word for word in line.split() if not word.startswith("--")]
                self._obey(words[0], words[1:])
            self._read = len(lines)
            for unit, wanted in list(self._wanted.items()):
                process = self._running.get(unit)
                if not wanted or (process is not None and process.poll() is None):
                    continue
                now = time.monotonic()
                if process is None or now - self._died.setdefault(unit, now) >= RESTART_S:
                    self._died.pop(unit, None)
                    self._running[unit] = self._spawn(unit)
                    (self._home / "active" / unit).touch()

    def _obey(self, verb: str, units: list[str]) -> None:
        for unit in units:
            process = self._running.get(unit)
            if verb == "start":
                self._wanted[unit] = True
            elif process is not None and verb == "kill":
                process.kill()
            elif verb in ("stop", "restart"):
                self._wanted[unit] = verb == "restart"
                (self._home / "active" / unit).unlink(missing_ok=True)
                if process is not None:
                    process.terminate()

    def _spawn(self, unit: str) -> Any:
        name = unit.removeprefix("swarm-").removesuffix(".service")
        if not name.startswith("app@"):
            return self._processes.start("-m", f"services.{name}", **self._environment)
        text = (self._home / f"etc/apps/{name[4:]}.env").read_text()
        settings = dict(line.partition("=")[::2] for line in text.splitlines())
        words = [settings["APP"], *settings["ARGUMENTS"].split()]
        return self._processes.start("-m", "services.apps", *words, **self._environment)


def scripts(runtime: Path, config: Path, release: str = "1-a") -> dict[str, str]:
    """Programs for the robot's PATH; `config` is the swarm.toml that it has."""
    return {
        "sudo": SUDO.format(runtime=runtime, python=sys.executable),
        "systemctl": SYSTEMCTL,
        "readlink": f"echo /opt/swarm/releases/{release}",
        "sha256sum": f"[ $# = 0 ] || exec /usr/bin/sha256sum {config}; exec /usr/bin/sha256sum",
    }
