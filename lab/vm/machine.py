"""One virtual machine of the lab: boot it, run commands in it, cut its power, boot it again.

A machine's folder holds its disk (what it has written over the image: it outlives a power cut), its console and the
folder that it sees as /share. Commands go over a virtio-serial port to the agent inside (guest/agent.py), or by ssh as
to any robot.
"""

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from lab.vm.build import Image

SYSTEMD, PLAIN = "/sbin/init", "/usr/lib/lab/init"
"""What a machine boots into: all of a robot's system, or a shell script that starts the agent in a few seconds."""

KERNEL = (
    *("console=ttyS0", "quiet", "loglevel=4", "panic=-1", "oops=panic", "mitigations=off", "tsc=reliable"),
    *("random.trust_cpu=on", "nowatchdog", "no_timer_check", "audit=0", "systemd.show_status=0", "net.ifnames=0"),
    *("rodata=off", "apparmor=0"),  # a second of page tables; profiles of nothing that is here
)

PLAIN_CPU = "Nehalem,+rdrand"
"""A processor that is a sixth faster to emulate than one with all that the emulator knows (`max`): no fifth level
of page tables to be walked after each switch of processes, no string functions for registers that are emulated."""

SNAPSHOT = "booted"
"""Name of the state in a saved disk (lab.vm.saved)."""

BOOT_SECONDS = 900.0
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
        cores: int = 1,
        radio: Path | None = None,
        steady: bool = False,
        alone: bool = False,
        saved: Path | None = None,
    ) -> None:
        """`radio`: the Unix socket at which the air gives this machine its Bluetooth controller.

        `steady`: its clock counts its own instructions, 2 ns each, while it has something to do. So a busy host makes
        it slow but not late, and a program that needs a millisecond inside needs it anywhere. It has one core. Several
        at once have each a clock of its own, which on a busy host do not go alike.

        `alone`: steady, and nothing outside has another clock: while it waits, its clock goes on to whatever comes next
        at once. So waiting takes next to no time, and what the host is busy with is in no figure. For a machine that
        waits for timers; what waits for its disk, as a whole system that boots, finds that it took long.

        `saved`: the disk of a machine like this one, saved when it had booted: what this one goes on from when it is
        switched on for the first time. After a power cut it boots.
        """
        self.name = name
        self.folder = folder
        self.share = folder / "share"
        """The machine's /share; the host's user owns what is in it."""
        self.port = 0
        """TCP port of this host that leads to the machine's ssh; another one after each start."""
        self._image = image
        self._init = init
        self._memory_mb = memory_mb
        self._cores = cores
        self._radio = radio
        self._steady = steady or alone
        self._alone = alone
        self._saved = saved
        self._resumes = False
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
        disk = self.folder / "disk.qcow2"
        self._resumes = self._saved is not None and not disk.exists()
        if self._resumes:
            shutil.copy(str(self._saved), disk)
        elif not disk.exists():
            made = ["qemu-img", "create", "-q", "-f", "qcow2", "-F", "raw", "-b", str(self._image.disk), str(disk)]
            subprocess.run(made, check=True)
        self.port = _free_port()
        path = self.folder / "agent.sock"
        with (self.folder / "console.log").open("ab") as console:
            self._process = subprocess.Popen(
                self._words(disk, path), stdin=subprocess.DEVNULL, stdout=console, stderr=console,
                start_new_session=True, preexec_fn=_die_with_us,  # noqa: PLW1509  it makes one system call
            )  # fmt: skip
        self._answers, self._next = {}, 0
        self._stream = self._connected(path)
        threading.Thread(target=self._read, args=(self._stream,), daemon=True).start()

    def wait_booted(self) -> None:
        """Until it takes commands."""
        if self._resumes:
            seed = os.urandom(64).hex()
            own = {"name": self.name, "now": time.time(), "seed": seed, "radio": self._radio is not None}
            self._send({"id": 0, "resumed": own})
        self._wait_for(0, BOOT_SECONDS, "boot")

    def save(self) -> Path:
        """Keep all of it in its disk, which others may begin with, and switch it off; its /share must be unmounted."""
        if self._stream is not None:
            self._stream.shutdown(socket.SHUT_RDWR)
        with socket.socket(socket.AF_UNIX) as monitor:
            monitor.connect(str(self.folder / "monitor.sock"))
            monitor.sendall(f"savevm {SNAPSHOT}\nquit\n".encode())
            with monitor.makefile("rb") as said:
                text = said.read().decode(errors="replace")
        self.kill()
        if "Error" in text:
            raise MachineError(f"{self.name} cannot be saved: {text}")
        return self.folder / "disk.qcow2"

    def kill(self) -> None:
        """Cut its power: what it has not written to its disk is lost."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def stop(self, seconds: float = 60.0) -> None:
        """Shut it down in good order, or by force after that time."""
        if self._process is not None:
            last = "poweroff" if self._init == SYSTEMD else "sync; echo o >/proc/sysrq-trigger"
            self.spawn(last)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)
        self.kill()

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
        """Run a shell command as root inside; its output. `MachineError` where its exit code is not `code`."""
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

    def wait(self, number: int, seconds: float) -> Result:
        """What the command with that number came to."""
        return self._wait_for(number, seconds, f"command {number}")

    def ssh_words(self) -> list[str]:
        """The command line of ssh up to and including the host; add a command, or nothing."""
        key = self.folder / "ssh_key"
        if not key.exists():
            shutil.copy(self._image.key, key)
            key.chmod(0o600)
        options = (
            *("StrictHostKeyChecking=no", "UserKnownHostsFile=/dev/null", "LogLevel=ERROR", "ConnectTimeout=100"),
            "KexAlgorithms=curve25519-sha256",  # the default is a fifth of a connection's work inside
        )
        words = [word for option in options for word in ("-o", option)]
        return ["ssh", "-i", str(key), "-p", str(self.port), *words, "root@127.0.0.1"]

    def ssh(self, command: str, seconds: float = 60.0) -> str:
        """Run a command as root by ssh; its standard output. Raises subprocess.CalledProcessError."""
        words = [*self.ssh_words(), command]
        done = subprocess.run(
            words, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=seconds, check=True
        )
        return done.stdout

    # -- inside ----------------------------------------------------------------------------------------------

    def _words(self, disk: Path, agent: Path) -> list[str]:
        words = ["qemu-system-x86_64", "-name", self.name, "-nodefaults", "-no-user-config", "-no-reboot"]
        # A /dev/kvm may be there and not work (machines of cloud services), so emulation is what is asked for.
        accelerator = os.environ.get("SWARM_LAB_ACCEL", "tcg,thread=multi")
        if self._steady:
            accelerator = "tcg,thread=single"
            words += ["-icount", f"shift=1,sleep={'off' if self._alone else 'on'}"]
        words += ["-accel", accelerator, "-cpu", PLAIN_CPU if accelerator.startswith("tcg") else "max"]
        words += ["-smp", str(self._cores), "-m", str(self._memory_mb), "-display", "none"]
        words += ["-machine", "q35,usb=off,smbus=off,vmport=off", "-serial", "stdio"]
        append = [*KERNEL, f"lab.init={self._init}", f"lab.name={self.name}", f"systemd.hostname={self.name}"]
        if self._radio is not None and not self._resumes:
            append.append("lab.radio")
        if self._alone:
            append.append("nohz=off")  # or its clock would go on by seconds while it waits for its disk
        words += ["-kernel", str(self._image.kernel), "-initrd", str(self._image.ramdisk), "-append", " ".join(append)]
        # A flush of the host's disk takes no time of the machine's, but would let its clock run on.
        cache = "unsafe" if self._alone else "writeback"
        words += ["-drive", f"file={disk},if=virtio,format=qcow2,cache={cache}"]
        words += ["-object", "rng-random,id=rng,filename=/dev/urandom", "-device", "virtio-rng-pci,rng=rng"]
        words += ["-nic", f"user,model=virtio-net-pci,restrict=on,hostfwd=tcp:127.0.0.1:{self.port}-:22"]
        words += ["-virtfs", f"local,path={self.share},mount_tag=share,security_model=none,id=share"]
        words += ["-device", "virtio-serial-pci", "-chardev", f"socket,id=agent,path={agent},server=on,wait=off"]
        words += ["-device", "virtserialport,chardev=agent,name=lab"]
        # One without a radio has a port that nobody joins: a machine goes on from another's state by the same devices.
        radio = self._radio or f"{self.folder / 'radio.sock'},server=on,wait=off"
        words += ["-chardev", f"socket,id=radio,path={radio}", "-device", "virtserialport,chardev=radio,name=radio"]
        words += ["-monitor", f"unix:{self.folder / 'monitor.sock'},server=on,wait=off"]
        return [*words, "-loadvm", SNAPSHOT] if self._resumes else words

    def _connected(self, path: Path) -> socket.socket:
        """The agent's port, once QEMU listens."""
        deadline = time.monotonic() + 30
        while True:
            stream = socket.socket(socket.AF_UNIX)
            try:
                stream.connect(str(path))
            except (FileNotFoundError, ConnectionRefusedError):
                stream.close()
                if not self.running or time.monotonic() > deadline:
                    raise MachineError(f"{self.name} did not start: {self._console()}") from None
                time.sleep(0.02)
            else:
                return stream

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

    def _wait_for(self, number: int, seconds: float, what: str) -> Result:
        deadline = time.monotonic() + seconds
        with self._changed:
            while number not in self._answers:
                left = deadline - time.monotonic()
                if left <= 0 or not self.running:
                    why = f"not within {seconds:g} s" if self.running else "it went off"
                    raise MachineError(f"{self.name}: {what}: {why}; its console ends with: {self._console()}")
                self._changed.wait(min(left, 1.0))
            return self._answers.pop(number)

    def _console(self) -> str:
        with contextlib.suppress(OSError):
            return (self.folder / "console.log").read_text(errors="replace")[-2000:]
        return ""


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def _die_with_us() -> None:
    """In the child: no machine outlives the test that started it, however that ends."""
    import ctypes

    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
