"""Robots that are nothing but a real OpenSSH server each, on a port and in a home folder of its own."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

from bench.rigs.ports import free_port
from bench.rigs.running import running

SSHD = next((path for path in ("/usr/sbin/sshd", "/usr/local/sbin/sshd") if Path(path).exists()), None)

CONFIG = """Port {port}
ListenAddress 127.0.0.1
HostKey {home}/host_key
PidFile none
AuthorizedKeysFile {keys}
StrictModes no
UsePAM no
PasswordAuthentication no
ForceCommand {home}/shell
LogLevel ERROR
KexAlgorithms curve25519-sha256
SetEnv SHLVL=2
"""
"""The key exchange takes the client 75 ms of CPU time less than the default one. A bash that sshd starts reads the
~/.bashrc of whoever runs this, unless it believes that it is not the first shell."""

SHELL = """#!/bin/sh
export HOME={home} PATH={home}/bin:/usr/bin:/bin
cd "$HOME"
{hook}
exec sh -c "$SSH_ORIGINAL_COMMAND"
"""

SUDO = """#!/bin/sh
shift
exec "$@"
"""

SYSTEMCTL = """#!/bin/sh
case "$*" in
*--property=ActiveState*) cat $HOME/state 2>/dev/null || echo active; exit ;;
*--property=StatusText*) cat $HOME/status 2>/dev/null; exit ;;
*--property=InvocationID*) cat $HOME/systemctl.log 2>/dev/null | wc -l; exit ;;
esac
echo "$@" >> $HOME/systemctl.log
case $1 in list-units) [ ! -e $HOME/units ] || cat $HOME/units ;; esac
"""


class FakeRobots:
    """Start robots, write the user's ssh and swarm configuration for them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ssh_config = folder / "ssh_config"
        self.config = folder / "swarm.toml"
        self._key = folder / "id"
        self._servers: dict[str, subprocess.Popen[bytes]] = {}
        self._ending = contextlib.ExitStack()
        self._waiting: set[str] = set()
        """Servers that have not been seen to take connections yet."""
        self._ports: dict[str, int] = {}
        self._keygen(self._key)

    def add(self, name: str, *, hook: str = "", known: bool = True, up: bool = True) -> Path:
        """A robot; `hook` is shell code before each command (one
        that hangs adds its pid to ./hung), `known` whether the user knows its host key. Its home."""
        home = self.folder / name
        (home / "bin").mkdir(parents=True)
        self._ports[name] = port = free_port()
        self._keygen(home / "host_key")
        (home / "sshd_config").write_text(CONFIG.format(port=port, home=home, keys=f"{self._key}.pub"))
        for path, text in (
            (home / "shell", SHELL.format(home=home, hook=hook)),
            (home / "bin/sudo", SUDO),
            (home / "bin/systemctl", SYSTEMCTL),
        ):
            path.write_text(text)
            path.chmod(0o755)
        public = (home / "host_key.pub" if known else Path(f"{self._key}.pub")).read_text()
        with (self.folder / "known_hosts").open("a") as file:
            file.write(f"[127.0.0.1]:{port} {public}")
        if up:
            assert SSHD is not None
            if os.geteuid() == 0:
                Path("/run/sshd").mkdir(exist_ok=True)
            command = [SSHD, "-D", "-f", str(home / "sshd_config")]
            self._servers[name] = self._ending.enter_context(running(command, stderr=subprocess.DEVNULL))
            self._waiting.add(name)
        self._write()
        return home

    def ready(self) -> None:
        """Wait until all servers take connections."""
        while self._waiting:
            name = min(self._waiting)
            with socket.socket() as sock:
                if sock.connect_ex(("127.0.0.1", self._ports[name])) == 0 or self._servers[name].poll() is not None:
                    self._waiting.remove(name)
                else:
                    time.sleep(0.01)

    def close(self) -> None:
        """End the servers, and what hangs."""
        self._ending.close()
        for hung in self.folder.glob("*/hung"):  # sshd leaves what it has started
            for pid in hung.read_text().split():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)

    def script(self, name: str, program: str, text: str) -> None:
        """Put a shell script into a robot's PATH."""
        path = self.folder / name / "bin" / program
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    def _write(self) -> None:
        text = "".join(f"Host {name}\n  HostName 127.0.0.1\n  Port {port}\n" for name, port in self._ports.items())
        text += f"Host *\n  IdentityFile {self._key}\n  IdentitiesOnly yes\n"
        text += f"  UserKnownHostsFile {self.folder}/known_hosts\n  StrictHostKeyChecking yes\n"
        self.ssh_config.write_text(text)
        robots = "".join(
            f'[[robots]]\nname = "{name}"\nlink = "tcp:127.0.0.1:{port}"\n' for name, port in self._ports.items()
        )
        topology = '[topology]\nshape = "line"\n' if len(self._ports) > 1 else ""
        self.config.write_text(f'network = "test"\n{topology}{robots}[mesh]\ninsecure = true\n')

    def _keygen(self, path: Path) -> None:
        keygen = shutil.which("ssh-keygen")
        assert keygen is not None
        subprocess.run([keygen, "-q", "-t", "ed25519", "-N", "", "-f", str(path)], check=True)
