"""The command that reaches a robot."""

import asyncio
import errno
import gc
import os
import signal
from pathlib import Path

import pytest
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

from laptop.fleet.ssh import everyone, ssh
from laptop.fleet.ssh.ssh import Host, HostError, Ssh, explain, last_words

pytest_plugins = ["fleet_fixtures"]


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EMFILE, errno.ENOMEM])
def test_a_computer_that_cannot_start_one_more_program_says_so(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """That ends the job of one robot, and not those of the others, as a stop."""

    async def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    with pytest.raises(HostError, match=f"ssh cannot be started: {os.strerror(number)}"):
        asyncio.run(Ssh().check(Host("r0", "r0"), "true"))
    assert issubclass(HostError, everyone.FAILURES)


@pytest.mark.parametrize("alone", [False, True])
def test_ctrl_c_at_the_terminal_ends_no_connection_of_a_stop(
    alone: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The terminal interrupts all processes of its session's foreground, which are those of this process' group."""
    (tmp_path / "ssh").write_text("#!/bin/sh\nexec cut -d' ' -f5,6 /proc/self/stat\n")
    (tmp_path / "ssh").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    said = asyncio.run(Ssh(alone=alone).check(Host("r0", "r0"), "true"))
    assert (said.split() == [str(os.getpgrp()), str(os.getsid(0))]) is not alone


DENIED = "me@r0: Permission denied (publickey).\n"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (f'signing failed for ED25519 "id" from agent: agent refused operation\n{DENIED}', "your ssh agent refuses"),
        (f'WARNING: UNPROTECTED PRIVATE KEY FILE!\nLoad key "id": bad permissions\n{DENIED}', "chmod 600"),
        ("Received disconnect from r0: Too many authentication failures\nDisconnected from r0\n", "IdentitiesOnly yes"),
        (DENIED, "ssh-add for a key with a passphrase"),
        ("agent refused operation\nTimeout, server r0 not responding.\n", "it went away"),
    ],
)
def test_what_keeps_a_key_from_being_taken_is_told(said: str, told: str) -> None:
    assert told in explain(Host("r0", "me@r0"), said)


@pytest.mark.parametrize(
    ("said", "command"),
    [
        ('  remove with:\n  ssh-keygen -f "/kh" -R "[r0]:2222"\n', 'ssh-keygen -f "/kh" -R "[r0]:2222"'),
        ("", "ssh-keygen -R r0"),
    ],
)
def test_the_command_that_forgets_a_host_key_is_one_that_works(said: str, command: str) -> None:
    """ssh knows a host by its address and port, and never by its user."""
    text = explain(Host("r0", "me@r0"), f"@ WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED! @\n{said}")
    assert text == f"its host key has changed; if set up anew: {command}"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("sudo: a password is required\n", "its user may not use sudo without a password"),
        ("sudo: /opt/swarm/current/bin/swarm: command not found", "not installed on it: swarm deploy"),
        ("sh: 1: /opt/swarm/current/bin/z_sub: not found", "not installed on it: swarm deploy"),
        ("env: '/opt/swarm/current/bin/swarm': No such file or directory", "not installed on it: swarm deploy"),
        ("swarm: /opt/swarm/current/bin/x.hex cannot be read: No such file or directory", "x.hex cannot be read"),
        ("swarm: no app nosuch\n\n", "swarm: no app nosuch"),
    ],
)
def test_the_last_words_of_a_command_say_what_is_to_be_done_where_that_is_known(said: str, told: str) -> None:
    assert told in last_words(f"before\n{said}")


@needs_ssh
@pytest.mark.parametrize("setting", ["RequestTTY force", "RemoteCommand sh", "LogLevel DEBUG"])
def test_settings_of_a_users_own_shell_change_nothing(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str], setting: str
) -> None:
    robots.add("r0")
    robots.ssh_config.write_text(f"{setting}\n{robots.ssh_config.read_text()}")
    assert run("command", "echo here; echo broken >&2; exit 3", "--json") == 1
    outcome = outcomes(capsys)["r0"]
    assert (outcome["lines"], outcome["text"]) == (["here"], "exit code 3: broken")


@needs_ssh
def test_why_ssh_fails_is_told_to_a_user_who_wants_no_messages_of_it(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r0", up=False)
    robots.ssh_config.write_text(f"LogLevel QUIET\n{robots.ssh_config.read_text()}")
    assert run("command", "true", "--json") == 1
    assert outcomes(capsys)["r0"]["text"] == "it runs no ssh server (or another port)"


@pytest.mark.parametrize("size", [0, 100_000, 1_000_000])
def test_a_command_that_is_cancelled_ends_without_a_word(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """Also where its input is more than a pipe holds, and where it was not begun to be sent."""
    monkeypatch.setattr(Ssh, "arguments", lambda *_: ["sh", "-c", "echo $$; exec sleep 600"])
    complaints: list[object] = []

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
        runs = asyncio.Event()
        running = asyncio.create_task(Ssh().run(Host("r0", "r0"), "", feed=[bytes(size)], on_line=lambda _: runs.set()))
        await runs.wait()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(main())
    gc.collect()
    assert complaints == []


@pytest.mark.parametrize("ended", [False, True])
def test_a_command_whose_pipes_another_process_holds_is_cancelled_without_a_word(
    monkeypatch: pytest.MonkeyPatch, ended: bool
) -> None:
    """As the connection that ssh shares does. Ctrl-C also ends ssh itself, which asyncio may see before the job."""
    monkeypatch.setattr(ssh, "_END_S", 0.05)
    monkeypatch.setattr(Ssh, "arguments", lambda *_: ["sh", "-c", f"sleep 600 & echo $!; {'' if ended else 'wait'}"])
    spawn, started, holder = ssh._spawn, [], []

    async def noted(arguments: list[str], **how: bool) -> asyncio.subprocess.Process:
        started.append(await spawn(arguments, **how))
        return started[-1]

    monkeypatch.setattr(ssh, "_spawn", noted)

    async def main() -> None:
        running = asyncio.create_task(Ssh().run(Host("r0", "r0"), "", feed=[bytes(1_000_000)], on_line=holder.append))
        while not holder or (ended and started[0].returncode is None):
            await asyncio.sleep(0)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    try:
        asyncio.run(main())
        started.clear()
        gc.collect()
    finally:
        os.kill(int(holder[0]), signal.SIGKILL)


def test_jobs_that_are_cancelled_have_time_to_end() -> None:
    """asyncio's loop would cancel the second one again in the middle of its end, after the first one has ended."""
    ended: list[str] = []

    async def job(host: Host, _: everyone.ReportProgress) -> str:
        try:
            await asyncio.Event().wait()
        finally:
            for _ in range(1 if host.robot == "r0" else 10):
                await asyncio.sleep(0)
            ended.append(host.robot)
        return ""

    async def main() -> None:
        hosts = [Host("r0", "r0"), Host("r1", "r1")]
        running = asyncio.create_task(everyone.each(hosts, job, 60.0))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
        assert ended == ["r0", "r1"]

    asyncio.run(main())
