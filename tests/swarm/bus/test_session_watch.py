"""A process whose session is dead ends, so that another one is started that hears stops."""

from unittest.mock import MagicMock

import pytest

from swarm.bus import session_watch
from swarm.bus.session_watch import SessionWatch

MOST = 5


def test_a_process_ends_when_its_router_left_several_questions_in_a_row_unanswered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    defects: list[BaseException] = []
    monkeypatch.setattr(session_watch, "defect", lambda error, _: defects.append(error))
    bus = MagicMock(connected=True)
    watch = SessionWatch(bus, MOST)
    for _ in range(2 * MOST):
        watch.look()
        bus.ask.call_args.args[1]("", b"")  # the router answers
    for _ in range(MOST - 1):
        watch.look()
    bus.connected = False
    watch.look()  # while the bus is away another process would hear no more
    bus.connected = True
    for _ in range(MOST):
        watch.look()
    assert not defects
    watch.look()
    assert len(defects) == 1
