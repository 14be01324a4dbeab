"""Priority, locked memory, no collector: taken where permitted, and named where not."""

import gc
import logging
import os
import resource
from types import SimpleNamespace

import pytest

from services.balancer import realtime


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch):
    """What would be asked of the system; nothing of it happens to the test's process."""
    calls = SimpleNamespace(policy=[], locked=[], refuse=False, unlimited=True, lock_result=0)

    def schedule(pid: int, policy: int, param: os.sched_param) -> None:
        if calls.refuse:
            raise PermissionError(1, "Operation not permitted")
        calls.policy.append((pid, policy, param.sched_priority))

    def lock(flags: int) -> int:
        calls.locked.append(flags)
        return calls.lock_result

    limit = lambda _: (resource.RLIM_INFINITY if calls.unlimited else 65536,) * 2  # noqa: E731
    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    monkeypatch.setattr(realtime.resource, "getrlimit", limit)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: SimpleNamespace(mlockall=lock))
    for name in ("collect", "freeze", "disable"):
        monkeypatch.setattr(gc, name, lambda name=name: calls.policy.append(name))
    return calls


def test_all_of_it_where_it_is_permitted(calls, caplog: pytest.LogCaptureFixture) -> None:
    realtime.enter(logging.getLogger("test"))
    # Its children (the bridge) start without the priority.
    assert calls.policy[0] == (0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, realtime.PRIORITY)
    assert calls.locked == [1 | 2 | 4]
    assert calls.policy[1:] == ["collect", "freeze", "disable"]
    assert caplog.text == ""


def test_what_is_refused_is_named_and_does_without(calls, caplog: pytest.LogCaptureFixture) -> None:
    calls.refuse, calls.unlimited = True, False
    realtime.enter(logging.getLogger("test"))
    assert "no real-time priority" in caplog.text
    assert "LimitMEMLOCK is not infinity" in caplog.text
    assert calls.locked == []
    assert calls.policy == ["collect", "freeze", "disable"]


def test_a_lock_that_fails_is_named(calls, caplog: pytest.LogCaptureFixture) -> None:
    calls.lock_result = -1
    realtime.enter(logging.getLogger("test"))
    assert "mlockall" in caplog.text
