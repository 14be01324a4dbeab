"""A command on one robot over the system's `ssh`, with the user's own configuration, keys and known hosts.

The system's client is what the user has set up and trusts: jump hosts, agents and names work as in the shell. It is
told never to ask (BatchMode): a question to eight robots at once has nobody to answer it.
"""

import asyncio
import codecs
import contextlib
import io
import os
import re
import shlex
import signal
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import IO, TextIO

from swarm.config import Config
from swarm.errors import LocalError, RemoteError
from swarm.frozen import frozen
from swarm.process.text import printable

CURRENT = "/opt/swarm/current"
"""The folder of the release that a robot runs. Its programs are in `bin`."""

OWN_NAME = "sed -n s/^SWARM_ROBOT=//p /etc/swarm/robot.env 2>/dev/null; true"
"""A command for the robot's shell that prints the name under which the robot was installed."""

CONNECT_TIMEOUT_S = 10
"""Seconds after which a robot that does not answer is given up."""

_ALIVE = ("-o", "ServerAliveInterval=5", "-o", "ServerAliveCountMax=3")
"""Options of ssh by which a robot that disappears during a command is noticed after 15 s."""

_PLAIN = ("-T", "-o", "RemoteCommand=none", "-o", "LogLevel=INFO")
"""Options of ssh that overrule the user's own settings. A terminal or another command would change the robot's answer.
With fewer messages the reason of a failed connection would be missing, with more of them the answer hard to find."""

CLIENT_FAILED = 255
"""Exit code of `ssh` itself, where no command has run or its end was not seen."""

NO_SSH = "there is no ssh here: sudo apt-get install openssh-client"
"""The message where this computer has no client."""

_END_S = 2.0
"""Seconds that a cancelled command may take to end."""

_CHUNK = 1 << 16
_LONGEST = 16 << 20
"""Bytes of an output, or of a line where it is taken line by line: a robot must not fill this computer's memory."""


class HostError(RemoteError):
    """A robot could not be reached, or did not do what it was told. The text says why and what to do."""


class CommandError(HostError):
    """A command has ended with another code than 0."""

    def __init__(self, code: int, words: str) -> None:
        super().__init__(words or f"exit code {code}")
        self.code = code


@frozen
class Host:
    """One robot as ssh knows it."""

    robot: str
    address: str
    """A name of the user's ssh configuration, or user@host."""


@frozen
class Done:
    """The end of a command on a robot."""

    code: int
    out: str
    err: str


def hosts(config: Config, only: Sequence[str] | None = None) -> tuple[Host, ...]:
    """Return the robots of the config, or those that are named. Raises `LocalError` for an unknown one."""
    names = dict.fromkeys(only or config.names)
    if unknown := [name for name in names if name not in config.names]:
        raise LocalError(f"{unknown[0]} is no robot of {config.path}; there are {', '.join(config.names)}")
    return tuple(Host(name, config.robot(name).host or name) for name in names)


class Ssh:
    """Runs commands on robots."""

    def __init__(self, config_file: Path | None = None, *, alone: bool = False, named: bool = True) -> None:
        """`config_file` is read in place of the user's ~/.ssh/config. `alone`: each command has its own connection,
        and Ctrl-C does not end it. One that ssh shares may be dead, and nobody has noticed. `named`: a robot that was
        installed under another name carries out no command, since its address in swarm.toml is that of another one."""
        self._config_file = config_file
        self._alone = alone
        self._named = named

    def arguments(self, host: Host, command: str) -> list[str]:
        """Return the command line that runs `command` (for the robot's shell) on `host`."""
        own = [] if self._config_file is None else ["-F", str(self._config_file)]
        own += ["-o", "ControlPath=none"] * self._alone
        command = _if_named(host) + command if self._named else command
        options = ("-o", "BatchMode=yes", "-o", f"ConnectTimeout={CONNECT_TIMEOUT_S}", *_ALIVE, *_PLAIN)
        return ["ssh", *own, *options, "--", host.address, command]

    async def run(
        self,
        host: Host,
        command: str,
        *,
        feed: Sequence[bytes] = (),
        on_line: Callable[[str], None] | None = None,
        on_complaint: Callable[[str], None] | None = None,
        hold: asyncio.Event | None = None,
        on_data: Callable[[bytes], None] | None = None,
    ) -> Done:
        """Run a command; `feed` is its input. `on_line` gets its output as it comes, line by line, or `on_data` as raw
        bytes; it is not collected then. `on_complaint` gets the lines of its standard error, which is collected anyway.

        With `hold` the input stays open after `feed` until that is set, or the command has ended.

        Raises `HostError` where the robot could not be reached or the connection broke. Cancelling ends the command's
        connection at once.
        """
        process = await _spawn(self.arguments(host, command), apart=self._alone)
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        reading = asyncio.ensure_future(_read(process.stdout, on_line, on_data))
        complaining = asyncio.ensure_future(_read(process.stderr, on_complaint, keep=True))
        writing = asyncio.ensure_future(_write(process.stdin, feed, hold))
        try:
            try:
                out, err = await asyncio.gather(reading, complaining)
                code = await process.wait()
            finally:
                for task in (reading, complaining, writing):
                    task.cancel()
                await asyncio.gather(reading, complaining, writing, return_exceptions=True)
        finally:
            await _end(process)
        if code == CLIENT_FAILED:
            raise HostError(explain(host, err))
        return Done(code, out, err)

    async def check(self, host: Host, command: str, *, feed: Sequence[bytes] = ()) -> str:
        """Run a command that must succeed and return its output; `HostError` with its last words where it does not."""
        done = await self.run(host, command, feed=feed)
        if done.code != 0:
            raise HostError(last_words(done.err) or last_words(done.out) or f"exit code {done.code}")
        return done.out

    async def follow(self, host: Host, command: str, tell: Callable[[str], None], *, feed: Sequence[bytes] = ()) -> int:
        """Run a command that must succeed and tell its output line by line; returns the number of lines.

        Raises `HostError` with its exit code and last words where it does not succeed.
        """
        count, last = 0, ""

        def line(text: str) -> None:
            nonlocal count, last
            count, last = count + 1, text
            tell(text)

        done = await self.run(host, command, feed=feed, on_line=line)
        if done.code != 0:
            raise CommandError(done.code, last_words(done.err) or last_words(last))
        return count


def _if_named(host: Host) -> str:
    """Return a shell command that is put before another one. On a robot that was installed under another name it ends
    with the exit code of a failed connection and the reason, and the other command does not run."""
    begin = shlex.quote(f"the robot at {host.address} says that it is")
    end = shlex.quote(f": correct `host` in swarm.toml, or swarm deploy --rename makes it {host.robot}")
    says = f'echo {begin} "$({OWN_NAME})"{end} >&2; exit {CLIENT_FAILED}'
    return f"case $({OWN_NAME}) in ''|{host.robot}) ;; *) {says};; esac; "


async def _spawn(arguments: Sequence[str], *, apart: bool) -> asyncio.subprocess.Process:
    """Start a command. `apart`: in a session of its own, so that Ctrl-C at the terminal does not reach it."""
    pipe = asyncio.subprocess.PIPE
    spawning = asyncio.ensure_future(
        asyncio.create_subprocess_exec(*arguments, stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=apart)
    )
    try:
        # Cancelled in between, asyncio would wait for ever for the end of pipes that it has not opened yet.
        return await asyncio.shield(spawning)
    except asyncio.CancelledError:
        await _end(await spawning)
        raise
    except FileNotFoundError:
        raise LocalError(NO_SSH) from None
    except OSError as error:  # no memory, or no process or file more for this user: others may be reached all the same
        raise HostError(f"ssh cannot be started: {error.strerror or error}") from None


async def _end(process: asyncio.subprocess.Process) -> None:
    """End a process and close its pipes, which a connection that ssh shares may hold open beyond its end. asyncio would
    complain of them when its loop has ended."""
    assert process.stdin is not None
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):  # `process.kill` may find its end first, and asyncio complains
            os.kill(process.pid, signal.SIGKILL)
        # asyncio sees the end when what is still in the pipes was read. Not `asyncio.timeout`: in Python 3.11.2 it
        # raises CancelledError in a job that was cancelled before.
        reading = asyncio.ensure_future(process.communicate())
        await asyncio.wait([reading], timeout=_END_S)
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
    if process.stdin.transport.get_write_buffer_size():
        process.stdin.transport.abort()
    # asyncio gives a `Process` no public way to close the pipes that are read: only its transport can.
    process._transport.close()  # type: ignore[attr-defined]
    await _closed(process.stdin)
    await asyncio.sleep(0)  # the loop closes pipes in its next round


_BROKEN = (BrokenPipeError, ConnectionResetError)
"""Errors of a pipe to a command that has ended; its exit code says more."""


async def _write(stream: asyncio.StreamWriter, feed: Sequence[bytes], hold: asyncio.Event | None) -> None:
    with contextlib.suppress(*_BROKEN):
        for data in feed:
            for start in range(0, len(data), _CHUNK):
                stream.write(data[start : start + _CHUNK])
                await stream.drain()
        if hold is not None:
            await hold.wait()
    stream.close()
    await asyncio.shield(_closed(stream))  # asyncio stumbles over a wait for it that was cancelled


async def _closed(stream: asyncio.StreamWriter) -> None:
    """Wait until a stream is closed. Its error is asked for, or asyncio would log one that nobody has seen."""
    with contextlib.suppress(*_BROKEN):
        await stream.wait_closed()


async def _read(
    stream: asyncio.StreamReader,
    on_line: Callable[[str], None] | None = None,
    on_data: Callable[[bytes], None] | None = None,
    *,
    keep: bool = False,
) -> str:
    """Return what is read, where nobody takes it as it comes or it is to be kept; raises `HostError` for too much."""
    kept = bytearray()
    rest = bytearray()
    while data := await stream.read(_CHUNK):
        if on_data is not None:
            on_data(data)
            continue
        if on_line is None or keep:
            kept += data
        if on_line is not None:
            first, *others = data.split(b"\n")
            rest += first
            for other in others:
                on_line(rest.decode(errors="replace"))
                rest = bytearray(other)
        if max(len(rest), len(kept)) > _LONGEST:
            raise HostError(f"it says {'more' if on_line is None else 'a line of more'} than {_LONGEST >> 20} MiB")
    if rest and on_line is not None:
        on_line(rest.decode(errors="replace"))
    return kept.decode(errors="replace")


_REASONS = (
    ("REMOTE HOST IDENTIFICATION HAS CHANGED", "its host key has changed; if set up anew: {forget}"),
    ("Host key verification failed", "its host key is not known here: ssh {address} once, and compare the key"),
    ("Too many authentication failures", "your ssh agent has too many keys for it: name one in ~/.ssh/config "
     "(IdentityFile, IdentitiesOnly yes)"),
    ("Could not resolve hostname", "no such host: name {address} in ~/.ssh/config, or give `host` in swarm.toml"),
    ("Connection refused", "it runs no ssh server (or another port)"),
    ("Connection timed out", "it does not answer: is it switched on, and in this network?"),
    ("No route to host", "it does not answer: is it switched on, and in this network?"),
    ("Network is unreachable", "this computer has no network to it"),
    ("not responding", "it went away in the middle of it"),
    ("closed by remote host", "it closed the connection in the middle of it"),
    ("Connection reset", "it closed the connection in the middle of it"),
    ("Broken pipe", "it went away in the middle of it"),
    ("agent refused operation", "your ssh agent refuses to use your key: unlock the agent, or confirm there"),
    ("UNPROTECTED PRIVATE KEY FILE", "ssh leaves out your key, which others may read: chmod 600 on its file"),
    ("Permission denied", "it takes none of your ssh keys: ssh-copy-id {address}, or ssh-add for a key with a "
     "passphrase"),
)  # fmt: skip
"""What a message of ssh means. Those about keys come last: another key may have been taken."""

ROBOT_REASONS = (
    ("a password is required", "its user may not use sudo without a password: add 'NAME ALL=(ALL) NOPASSWD: ALL' "
     "to /etc/sudoers.d there"),
    ("a terminal is required", "its user may not use sudo without a password: add 'NAME ALL=(ALL) NOPASSWD: ALL' "
     "to /etc/sudoers.d there"),
    ("not in the sudoers file", "its user may not use sudo: log in as one who may"),
    ("sudo: not found", "it has no sudo: flash Raspberry Pi OS Lite, or apt-get install sudo"),
    ("sudo: command not found", "it has no sudo: flash Raspberry Pi OS Lite, or apt-get install sudo"),
)  # fmt: skip
"""What a message of a robot's shell means."""

NOT_INSTALLED = "Balboa Swarm is not installed on it: swarm deploy"
_NO_RELEASE = re.compile(rf"{CURRENT}/bin/\w+\W{{0,3}}: (command )?not found$|{CURRENT}/bin/\w+\W{{0,5}}No such file")
"""What a shell, sudo (the first) or env (the second) says of a program of the release that is not there."""

_FORGET = re.compile(r"^\s*(ssh-keygen -f .*)$", re.MULTILINE)
"""The line in which ssh itself says how to forget a host key; not every system's does."""


def explain(host: Host, err: str) -> str:
    """Return why ssh itself failed, and what to do."""
    own = _FORGET.search(err)
    forget = printable(own[1].strip()) if own else f"ssh-keygen -R {host.address.rpartition('@')[2]}"
    reasons = ((sign, reason.format(address=host.address, forget=forget)) for sign, reason in _REASONS)
    return explained(err, reasons) or f"ssh, or the command, ended with code {CLIENT_FAILED} without a word"


def explained(err: str, reasons: Iterable[tuple[str, str]]) -> str:
    """Return the reason of the first sign in `reasons` that is part of `err`, else the last words of `err`."""
    return next((reason for sign, reason in reasons if sign in err), last_words(err))


def last_words(text: str) -> str:
    """Return the last line that says something, in printable form; where it is known what it means, that."""
    last = next((printable(line.strip()) for line in reversed(text.splitlines()) if line.strip()), "")
    if _NO_RELEASE.search(last):
        return NOT_INSTALLED
    return next((reason for sign, reason in ROBOT_REASONS if sign in last), last)


def copy_text(source: IO[bytes], to: TextIO) -> None:
    """Write what comes from `source` to a stream until its end, a question without a line end at once.

    The stream is one of this process' own, which are guarded: a robot's text does not steer the terminal. `ssh` ends
    its own lines with a carriage return, too, which would be shown.
    """
    decoder = io.IncrementalNewlineDecoder(codecs.getincrementaldecoder("utf-8")("replace"), translate=True)
    while data := source.read1(4096):  # type: ignore[attr-defined]  # a BufferedReader
        to.write(decoder.decode(data))
        to.flush()
