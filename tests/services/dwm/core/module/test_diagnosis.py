"""Each thing that can be wrong has a name and a remedy; a set-up that is right has none."""

import inspect
import math
import random
import re
from dataclasses import replace
from pathlib import Path

import pytest

from services.dwm import tool
from services.dwm.core.module import diagnosis
from services.dwm.core.module.calls import ModuleStatus, Settings, UpdateRate, Version
from services.dwm.core.module.diagnosis import DiagnosisWatch
from services.dwm.core.module.exchange import Trouble
from services.dwm.core.module.tlv import AnchorRange, Location, Position
from sim.core.uwb import ErrorModel, Module, Tag
from swarm.config.types import Anchor

ANCHORS = (
    Anchor("D001", 0.0, 0.0),
    Anchor("D002", 2.0, 0.0),
    Anchor("D003", 2.0, 2.0),
    Anchor("D004", 0.0, 2.0),
)
HERE = (0.7, 1.2)
TAG, GOOD, JOINED = Settings(anchor=False), UpdateRate(1, 1), ModuleStatus(True, True)
UNBIASED = ErrorModel(slope=1.0, offset=0.0, engine_offset=0.0)


def modules(anchors=ANCHORS):
    return [Module(a.address, a.x, a.y, a.z, Position(a.x, a.y, a.z, 100)) for a in anchors]


def answers(around, count=40, seed=1, model=UNBIASED, place=HERE):
    tag = Tag(random.Random(seed), model)
    return [tag.measure(around, *place, 0.0) for _ in range(count)]


def codes(findings):
    assert all(finding.text and finding.remedy for finding in findings)
    return [finding.code for finding in findings]


def all_of(locations, anchors=ANCHORS, known=None):
    return diagnosis.of_answers(locations, anchors, known or {}) + diagnosis.of_standing(locations, anchors)


@pytest.mark.parametrize("seed", range(20))
def test_what_is_right_is_left_alone(seed):
    place = (0.2 + 0.08 * seed, 1.9 - 0.07 * seed)
    assert codes(all_of(answers(modules(), seed=seed, place=place))) == []
    # the simulated module's usual errors, uncalibrated
    assert codes(all_of(answers(modules(), seed=seed, model=ErrorModel(), place=place))) == []


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        ("silent", "no-module"),
        ("garbled", "garbled"),
        ("shell", "shell-mode"),
        ("layout", "layout"),
        ("refused", "refused"),
    ],
)
def test_each_trouble_of_the_line_has_its_finding(kind, code):
    assert codes([diagnosis.of_trouble(Trouble(kind, "so"))]) == [code]


@pytest.mark.parametrize(
    ("firmware", "found"), [((1, 3, 0, 1), []), ((1, 1, 1, 1), ["firmware"]), ((2, 0, 0, 1), ["firmware"])]
)
def test_another_firmware_of_the_module_is_found(firmware, found):
    assert codes(diagnosis.of_version(Version(firmware, 0, 0))) == found


@pytest.mark.parametrize(
    ("settings", "rate", "status", "found"),
    [
        (TAG, GOOD, JOINED, []),
        (TAG, UpdateRate(1, 100), JOINED, []),  # without stationary detection the slow rate is never used
        (replace(TAG, stationary=True), GOOD, JOINED, []),
        (replace(TAG, stationary=True), UpdateRate(1, 100), JOINED, ["still"]),
        (TAG, UpdateRate(5, 5), JOINED, ["slow"]),
        (replace(TAG, low_power=True), GOOD, JOINED, ["low-power"]),
        (replace(TAG, engine=False), GOOD, JOINED, ["no-engine"]),
        (replace(TAG, uwb=0), GOOD, JOINED, ["uwb-off"]),
        (TAG, GOOD, ModuleStatus(False, False), ["no-network"]),
        (Settings(anchor=True), GOOD, ModuleStatus(False, False), ["role", "no-network"]),
    ],
)
def test_wrong_settings_of_a_tag_are_found(settings, rate, status, found):
    assert codes(diagnosis.of_settings(settings, rate, status, anchor=False)) == found


def test_a_tag_that_shall_be_an_anchor():
    assert codes(diagnosis.of_settings(TAG, GOOD, JOINED, anchor=True)) == ["role"]


@pytest.mark.parametrize(
    ("anchors", "found"),
    [
        (ANCHORS, []),
        ((), ["no-anchors"]),
        (ANCHORS[:2], ["few-anchors"]),
        ((*ANCHORS[:2], Anchor("D009", 4.0, 0.01)), ["collinear"]),
    ],
)
def test_the_anchors_of_the_file(anchors, found):
    assert codes(diagnosis.of_anchors(anchors)) == found


def test_a_configuration_without_anchors_is_named():
    found = all_of([Location(Position(0.0, 0.0, 0.0, 0), ())] * 20)
    assert codes(found) == ["missing-anchor"] * 4 + ["no-ranges"]


def test_fewer_than_three_anchors_are_named():
    found = codes(all_of(answers(modules(ANCHORS[:2]))))
    assert [code for code in found if code != "missing-anchor"] == ["few-anchors"]


def test_target_and_robots_may_crowd_anchors_out():
    robots = [Module(f"DE0{i}", 0.7 + 0.1 * i, 1.2, 0.0, Position(0.0, 0.0, 0.0, 0)) for i in (1, 2)]
    found = all_of(answers([*modules(), *robots]), known={"DE01": "r1", "DE02": "r2"})
    (few,) = [finding for finding in found if finding.code == "few-anchors"]
    assert "a tag ranges to 4 modules, and DE01, DE02 take 2 of these places" in few.text


def test_anchors_in_sight_in_a_line():
    line = (*ANCHORS[:2], Anchor("D005", 4.0, 0.0), Anchor("D006", 3.0, 5.0))
    found = codes(all_of(answers(modules(line[:3])), line))
    assert "collinear" in found


def test_no_fix_though_there_are_anchors():
    """The anchors' modules were never told where they are."""
    around = [replace(module, known=Position(0.0, 0.0, 0.0, 0)) for module in modules()]
    assert codes(all_of(answers(around))) == ["no-fix"]


def test_a_moved_anchor_is_named():
    anchors = (*ANCHORS, Anchor("D005", 1.0, -0.8))
    moved = [replace(anchor, x=0.9, y=3.2) if anchor.address == "D004" else anchor for anchor in anchors]
    around = [replace(m, known=Position(a.x, a.y, 0.0, 100)) for m, a in zip(modules(moved), anchors, strict=True)]
    locations = [one for place in ((1.4, 0.6),) for one in answers(around, place=place)]
    # Five are up, and a tag ranges to four: the others are seen from elsewhere.
    tag = Tag(random.Random(1), UNBIASED)
    locations += [tag.measure(around[3:4], 1.4, 0.6, 0.0) for _ in range(20)]
    (finding,) = diagnosis.of_standing(locations, anchors)
    assert finding.code == "anchor-moved"
    assert "one does without D004 (" in finding.text
    assert " or without" not in finding.text


def test_of_four_anchors_those_that_may_have_moved_are_named():
    moved = (*ANCHORS[:3], Anchor("D004", 0.9, 3.2))
    around = [replace(m, known=Position(a.x, a.y, 0.0, 100)) for m, a in zip(modules(moved), ANCHORS, strict=True)]
    (finding,) = all_of(answers(around, place=(1.4, 0.6)))
    assert finding.code == "anchor-moved"
    assert "without D004" in finding.text


def test_a_moved_anchor_of_three_is_noticed():
    anchors = ANCHORS[:3]
    moved = (*anchors[:2], Anchor("D003", 3.2, 2.8))
    around = [replace(m, known=Position(a.x, a.y, 0.0, 100)) for m, a in zip(modules(moved), anchors, strict=True)]
    assert "anchor-moved" in codes(all_of(answers(around), anchors))


def test_an_anchor_that_was_set_up_elsewhere():
    around = [*modules()[:3], replace(modules()[3], known=Position(0.5, 2.0, 0.0, 100))]
    found = all_of(answers(around))
    assert codes(found) == ["anchor-setup"]
    assert "D004 says it is at (0.50, 2.00, 0.00) m, swarm.toml has (0.00, 2.00, 0.00) m" in found[0].text


def test_one_address_twice_in_an_answer():
    location = answers(modules(), 1, model=replace(UNBIASED, missing=0.0))[0]
    twice = replace(location, ranges=(*location.ranges, location.ranges[0]))
    assert codes(diagnosis.of_answers([twice] * 5, ANCHORS, {})) == ["duplicate-address"]


def test_two_modules_that_take_turns_under_one_address():
    near, far = answers(modules()), answers([*modules()[:3], replace(modules()[3], x=4.0)])
    mixed = [one for pair in zip(near, far, strict=True) for one in pair]
    found = diagnosis.of_standing(mixed, ANCHORS)
    assert codes(found)[0] == "duplicate-address"
    assert "D004" in found[0].text


def test_an_anchor_with_the_address_of_the_tag():
    assert "duplicate-address" in codes(diagnosis.of_answers(answers(modules()), ANCHORS, {}, own="D001"))


def test_an_impossible_range_is_found():
    locations = answers(modules())
    broken = replace(locations[-1], ranges=(AnchorRange("D001", 4000.0, 100, modules()[0].known),))
    assert "impossible-range" in codes(diagnosis.of_answers([*locations, broken], ANCHORS, {}))
    apart = [replace(m, x=m.x + 9.0) if m.address == "D002" else m for m in modules()]
    assert "impossible-range" in codes(diagnosis.of_standing(answers(apart), ANCHORS))


def test_strangers_are_noted_and_robots_are_none():
    around = [*modules()[:3], Module("DE01", 1.0, 1.0, 0.0, Position(0.0, 0.0, 0.0, 0))]
    assert "unknown-anchor" in codes(all_of(answers(around), ANCHORS[:3]))
    assert codes(all_of(answers(around), ANCHORS[:3], {"DE01": "r1"})) == []


def test_a_running_service_tells_what_is_new_once():
    watch, told = DiagnosisWatch(ANCHORS, {}, 0.0), []
    few = answers(modules(ANCHORS[:2]), 100)
    for step, location in enumerate([*few, *answers(modules(), 100), *few]):
        told += [(math.floor(step / 100), finding.code) for finding in watch.report(location, step * 0.1)]
    assert [part for part, code in told if code == "few-anchors"] == [0, 2]
    assert {code for _, code in told} == {"few-anchors", "missing-anchor"}


def test_the_page_of_the_module_has_each_name_of_a_finding():
    named = {
        diagnosis.of_trouble(Trouble(kind, "")).code for kind in ("silent", "garbled", "shell", "layout", "refused")
    }
    for module in (diagnosis, tool):
        named |= set(re.findall(r'ModuleFinding\(\s*"([a-z-]+)"', inspect.getsource(module)))
    page = (Path(__file__).parents[5] / "docs/reference/robot/uwb-module.md").read_text()
    rows = page.partition("## What can be wrong")[2].splitlines()
    told = [name for row in rows if row.startswith("| `") for name in re.findall(r"`([a-z-]+)`", row.split("|")[1])]
    assert sorted(told) == sorted(named)
