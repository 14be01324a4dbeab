"""One virtual machine of the lab: boot it, run commands in it, cut its power, boot it again.

A machine is a kernel that is a program of this host (lab.vm.kernel). Its folder holds its disk (what it has written
over the image: it outlives a power cut), its console and the folder that it sees as /share. Commands go over a serial
line to the agent inside (guest/agent.py), or by ssh as to any robot.
"""

import contextlib
import ctypes
import itertools
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from lab import waiting
from lab.vm.build import Image
from lab.vm.network import Wire
from lab.waiting import Wait

SYSTEMD, PLAIN = "/sbin/init", "/usr/lib/lab/init"
"""What a machine boots into: all of a robot's system, or a shell script that starts the agent in a second."""

KERNEL = (
    *("root=/dev/ubda", "rw", "con=null", "con0=null,fd:1", "ssl=null", "quiet", "loglevel=4", "panic=1"),
    *("systemd.show_status=0", "net.ifnames=0"),
)

MEMORY = "/dev/shm"  # noqa: S108  the kernel makes its file there in one that has no name
"""Where the host keeps a machine's memory."""

_turn = itertools.count(int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")))
"""Which of the host's processors is the next machine's; each test process begins with another one."""

BOOT_SECONDS = 200.0
"""At most; a busy host is slow."""


class MachineError(Exception):
    """A machine did not do what a test needs of it; the text has the end of what it said."""


@dataclass(frozen=True)
class Result:
    """What a command inside came to."""

    code: int
    """Its exit code; 124 where it took too long."""
    output: str
    """Standard output and error, the end of them."""


class Machine:
    """One machine in that folder, made where it is not there yet. Leaving the `with` block switches it off."""

    def __init__(
        self,
        image: Image,
        folder: Path,
        name: str,
        *,
        init: str = SYSTEMD,
        memory_mb: int = 512,
        radio: Path | None = None,
        niceness: int = 0,
    ) -> None:
        """`radio`: the Unix socket at which the air gives this machine its Bluetooth controller. `niceness`: of its
        programs on the host; less than 0 where something in it falls over in real time."""
        self.name = name
        self.folder = folder
        self.share = folder / "share"
        """The machine's /share; the host's user owns what is in it."""
        self._image = image
        self._init = init
        self._memory_mb = memory_mb
        self._radio = radio
        self._niceness = niceness
        processors = sorted(os.sched_getaffinity(0))
        self._processor = processors[next(_turn) % len(processors)]
        self._wire: Wire | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: dict[int, Result] = {}
        self._next = 0
        self._changed = threading.Condition()
        self._stream: socket.socket | None = None
        self.share.mkdir(parents=True, exist_ok=True)

    # -- power -----------------------------------------------------------------------------------------------

    def start(self) -> float:
        """Switch it on and wait until it takes commands; s that took."""
        began = time.monotonic()
        self.switch_on()
        self.wait_booted()
        return time.monotonic() - began

    def switch_on(self) -> None:
        """Begin to boot. The machine ends with the thread that calls this, so it must be one that lasts."""
        with (self.folder / "console.log").open("ab") as console, contextlib.ExitStack() as lines:
            ours, agent = socket.socketpair()
            lines.enter_context(agent)
            devices = {1: agent}
            if self._radio is not None:
                devices[2] = lines.enter_context(socket.socket(socket.AF_UNIX))
                devices[2].connect(str(self._radio))
            self._wire = Wire()
            self._process = subprocess.Popen(
                self._words(self._wire, devices),
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=console,
                env={**os.environ, "TMPDIR": MEMORY},
                pass_fds=[each.fileno() for each in devices.values()],
                start_new_session=True,
                preexec_fn=self._begin,  # noqa: PLW1509  it makes a few system calls
            )
        self._answers, self._next = {}, 0
        self._stream = ours
        threading.Thread(target=self._read, args=(self._stream,), daemon=True).start()

    def wait_booted(self) -> None:
        """Until it takes commands, and has a network."""
        self._wait_for(0, BOOT_SECONDS, "boot")
        if self._wire is not None:
            self._wire.up()

    def kill(self) -> None:
        """Cut its power: what it has not written to its disk is lost."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # each program's memory inside is a process here
            self._process.wait()
            self._process = None
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if self._wire is not None:
            self._wire.close()
            self._wire = None

    def stop(self, seconds: float = 60.0) -> None:
        """Shut it down in good order, or by force after that time."""
        if self._process is not None:
            self.spawn("poweroff" if self._init == SYSTEMD else "sync; poweroff -f")
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)
        self.kill()

    @property
    def address(self) -> str:
        """Where the machine's ssh answers, from this host alone; another one after each start."""
        if self._wire is None:
            raise MachineError(f"{self.name} is switched off")
        return self._wire.machine

    @property
    def running(self) -> bool:
        """Whether it is switched on."""
        return self._process is not None and self._process.poll() is None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()

    # -- commands --------------------------------------------------------------------------------------------

    def run(self, command: str, seconds: float = 60.0, *, code: int | None = 0) -> str:
        """Run a shell command as root inside and return its output. Raises `MachineError` where its exit code is not
        `code`, and `WaitedInVainError` where the machine does not answer."""
        result = self._wait_for(self.spawn(command, seconds), seconds + 30, command)
        if code is not None and result.code != code:
            raise MachineError(f"{self.name}: {command}: exit code {result.code}: {result.output[-4000:]}")
        return result.output

    def spawn(self, command: str, seconds: float = 3600.0) -> int:
        """Start a shell command and do not wait for it; its number, for `wait`."""
        with self._changed:
            self._next += 1
            number = self._next
        self._send({"id": number, "command": command, "seconds": seconds})
        return number

    def _send(self, request: dict[str, Any]) -> None:
        if self._stream is None:
            raise MachineError(f"{self.name} is switched off")
        with self._changed:
            self._stream.sendall(json.dumps(request).encode() + b"\n")

    def wait(self, number: int, seconds: float, what: str, state: Callable[[], object] | None = None) -> Result:
        """Wait for the command with that number to end, and return what it came to. `what` and `state` describe it in
        the lines that a long wait prints (`lab.waiting`)."""
        return self._wait_for(number, seconds, what, state)

    def ssh_words(self) -> list[str]:
        """The command line of ssh up to and including the host; add a command, or nothing."""
        key = self.folder / "ssh_key"
        if not key.exists():
            shutil.copy(self._image.key, key)
            key.chmod(0o600)
        options = ("StrictHostKeyChecking=no", "UserKnownHostsFile=/dev/null", "LogLevel=ERROR", "ConnectTimeout=100")
        words = [word for option in options for word in ("-o", option)]
        return ["ssh", "-i", str(key), *words, f"root@{self.address}"]

    def ssh(self, command: str, seconds: float = 60.0) -> str:
        """Run a command as root by ssh and return its standard output; its exit code must be 0."""
        return waiting.run(f"{self.name}: ssh {command}", [*self.ssh_words(), command], seconds)

    # -- inside ----------------------------------------------------------------------------------------------

    def _words(self, wire: Wire, devices: dict[int, socket.socket]) -> list[str]:
        disk = f"ubd0={self.folder / 'disk.cow'},{self._image.disk}"
        words = [str(self._image.kernel), f"mem={self._memory_mb}M", disk, *KERNEL, f"init={self._init}"]
        words += [f"ssl{number}=fd:{line.fileno()}" for number, line in devices.items()]
        words += [f"vec0:transport=tap,ifname={wire.interface}", f"lab.address={wire.machine}"]
        words += [f"lab.name={self.name}", f"systemd.hostname={self.name}", f"lab.share={self.share.absolute()}"]
        return [*words, "lab.radio"] if self._radio is not None else words

    def _begin(self) -> None:
        """In the child: no machine outlives the test that started it, however that ends, and none leaves a core."""
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        # A machine has one processor, so its programs take turns. Where the host wakes each on another processor than
        # the one before, a turn takes several times as long (61 % of a processor for a robot's I2C bus, not 10 %).
        os.sched_setaffinity(0, {self._processor})
        niceness = os.nice(self._niceness)
        # Linux shares a processor between sessions (sched(7), autogroups) before it looks at niceness within them.
        with contextlib.suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(niceness))

    def _read(self, stream: socket.socket) -> None:
        """The reading thread: answers of the agent, until the machine is off."""
        with contextlib.suppress(OSError, ValueError), stream.makefile("rb") as lines:
            for line in lines:
                answer = json.loads(line)
                with self._changed:
                    self._answers[answer["id"]] = Result(answer["code"], answer["output"])
                    self._changed.notify_all()
        with self._changed:
            self._changed.notify_all()

    def _wait_for(self, number: int, seconds: float, what: str, state: Callable[[], object] | None = None) -> Result:
        wait = Wait(f"{self.name}: {what}", seconds, state or (lambda: f"console {self._console()!r}"))
        with self._changed:
            while number not in self._answers:
                if not self.running:
                    wait.fail("the machine went off")
                self._changed.wait(min(wait.look(), 1.0))
            return self._answers.pop(number)

    def _console(self) -> str:
        with contextlib.suppress(OSError):
            return (self.folder / "console.log").read_text(errors="replace")[-2000:]
        return ""
