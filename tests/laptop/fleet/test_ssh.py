"""The command that reaches a robot."""

import asyncio
import errno
import os

import pytest

from laptop.fleet.ssh.everyone import FAILURES
from laptop.fleet.ssh.ssh import Host, HostError, Ssh


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EMFILE, errno.ENOMEM])
def test_a_computer_that_cannot_start_one_more_program_says_so(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """That ends the job of one robot, and not those of the others, as a stop."""

    async def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    with pytest.raises(HostError, match=f"ssh cannot be started: {os.strerror(number)}"):
        asyncio.run(Ssh().check(Host("r0", "r0"), "true"))
    assert issubclass(HostError, FAILURES)
