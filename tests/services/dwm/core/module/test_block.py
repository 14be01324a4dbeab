"""The DWM1001 behind the ATmega, as the balancer tells of it."""

from dataclasses import replace

import pytest
from dwm_frames import LOCATION

from services.dwm.core.module.block import PATIENCE, Block
from services.dwm.core.module.poller import ModuleHealth, ModuleReport
from swarm.messages import Uwb, UwbRange

RANGES = tuple(
    UwbRange(r.anchor, r.distance, r.quality, r.position.x, r.position.y, r.position.z, r.position.quality)
    for r in LOCATION.ranges
)
GOOD = Uwb(1.0, "ok", 0, 0, 1, 0, 0.03, 2.635, 1.055, 3.74, 100, 4, RANGES)
NONE_YET = Uwb(1.0, "silent", 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, 0, ())


def test_a_report_is_that_of_the_module_with_its_age():
    block = Block(0.0)
    health, report = block.receive(GOOD, 1.02)
    assert health == ModuleHealth(True, "")
    assert report == ModuleReport(LOCATION, pytest.approx(0.05))
    assert block.receive(replace(GOOD, t=1.1), 1.1) == []  # the same one
    assert block.receive(replace(GOOD, t=1.2, sequence=2), 1.2) == [ModuleReport(LOCATION, pytest.approx(0.03))]


def test_a_balancer_that_starts_anew_counts_from_one_again():
    block = Block(0.0)
    block.receive(replace(GOOD, sequence=500), 1.0)
    block.receive(NONE_YET, 1.1)
    assert ModuleReport(LOCATION, pytest.approx(0.03)) in block.receive(replace(GOOD, t=1.2), 1.2)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"state": "silent"}, "does not answer the ATmega: is it wired"),
        ({"state": "broken"}, "shell mode, a bad wire, or another firmware"),
        ({"state": "refused", "error": 4}, "refuses the ATmega's loc_get: busy"),
        ({"state": "refused", "error": 9}, "error 9"),
    ],
)
def test_trouble_is_told_once_when_it_lasts(changes, words):
    block = Block(0.0)
    assert block.receive(GOOD, 1.0)[0] == ModuleHealth(True, "")
    told = [event for step in range(9) for event in block.receive(replace(GOOD, **changes), 2.0 + step)]
    (health,) = told
    assert (health.working, words in health.reason) == (False, True)
    assert block.receive(GOOD, 20.0) == [ModuleHealth(True, "")]


def test_a_pause_for_a_request_is_no_trouble():
    block = Block(0.0)
    block.receive(GOOD, 1.0)
    for step in range(9):
        assert block.receive(replace(GOOD, state="paused"), 1.0 + step / 10) == []


def test_a_silent_balancer_is_told():
    block = Block(0.0)
    assert block.handle_timer(PATIENCE - 0.1) == []
    (health,) = block.handle_timer(PATIENCE + 0.1)
    assert "is it running" in health.reason
    assert block.handle_timer(PATIENCE + 1) == []
    assert block.receive(GOOD, 9.0)[0] == ModuleHealth(True, "")
