"""Each line of a run's progress stays one line, whatever robots and apps say."""

import io
import os
from pathlib import Path

import pytest

from sim.processes.monitor import Seen
from sim.processes.progress import TERMINAL_PERIOD_S, ProgressDisplay, _fit, say
from sim.scenario.options import parse
from sim.scenario.scenario import build
from swarm.messages import AppLog, AppProgress, BalancerState

FORGED = "stuck\n   9.9 s  r1  done\r\x1b[2J"
SHOWN = r"stuck\n   9.9 s  r1  done\r\u001b[2J"


class Screen(io.StringIO):
    """A terminal with a file descriptor."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self._number = number

    def fileno(self) -> int:
        return self._number


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(stream: io.StringIO) -> str:
    """What is written of two robots, twice: one robot names a forged fault, an app of the other a forged reason."""
    display = ProgressDisplay(stream, build(parse(["consensus", "--robots", "2"]), Path("run")))
    body = BalancerState(1.0, "fault", 0.0, 0.0, 0.0, 0.0, 0.0, None, 1, 0.0, 0.0, FORGED)
    seen = {"r0": Seen(balancer=body), "r1": Seen(progress=AppProgress(1.0, "waiting", 3, ("r0",), FORGED))}
    for number in range(2):
        display.show(10 * TERMINAL_PERIOD_S * number, 1.0, seen, {"r0": (), "r1": ()})
    return stream.getvalue()


def test_what_robots_name_forges_no_line_and_the_block_is_erased_to_its_first_line() -> None:
    block = f"   1.0 s\n  r0  {SHOWN}\n  r1  k=3 waits for r0 ({SHOWN})\n"
    assert shown(Terminal()) == f"{block}\x1b[3F\x1b[J{block}"


def test_without_a_terminal_a_swarm_is_one_line_whatever_it_names() -> None:
    assert shown(io.StringIO()) == f"   1.0 s  r0 {SHOWN}; r1 k=3 waits for r0 ({SHOWN})\n" * 2


def test_a_robot_that_is_off_does_nothing_of_what_it_told_before() -> None:
    out = io.StringIO()
    seen = {
        "r0": Seen(progress=AppProgress(1.0, "running", 3, (), "")),
        "r1": Seen(progress=AppProgress(1.0, "running", 3, (), "")),
    }
    display = ProgressDisplay(out, build(parse(["consensus", "--robots", "2"]), Path("run")))
    display.show(1.0, 1.0, seen, {"r0": (), "r1": ()}, {"r1"})
    assert out.getvalue() == "   1.0 s  r0 k=3; r1 off\n"


def test_a_line_of_an_app_and_a_sentence_that_stays_are_one_line_each() -> None:
    out = io.StringIO()
    say(out, "r0", AppLog(1.0, "info", FORGED))
    ProgressDisplay(out, build(parse(["consensus"]), Path("run"))).say(FORGED)
    assert out.getvalue() == f"    1.000 s  r0  {SHOWN}\n{SHOWN}\n"


def test_a_block_fits_on_the_screen_or_it_would_not_be_erased_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = ["   1.0 s", *(f"  r{number}  balancing -0.3 deg, k=48 waits for r3" for number in range(30))]
    sizes = {1: (40, 24), 2: (0, 0), 3: (200, 2)}
    monkeypatch.setattr(os, "get_terminal_size", lambda number: os.terminal_size(sizes[number]))
    small, unknown, low = (_fit(lines, Screen(number)) for number in sizes)
    assert small[:2] == ["   1.0 s", "  r0  balancing -0.3 deg, k=48 waits ..."]
    assert (len(small), small[-1]) == (23, "  ... and 9 more robots")
    assert max(map(len, small)) == 40
    assert unknown == lines
    assert low == ["   1.0 s", "  ... and 30 more robots"]
    assert _fit(lines, io.StringIO()) == lines
