"""Both sides of the wire have one layout: firmware/layout.h and services/balancer/core/devices/balboa.py. No tools."""

import itertools

import pytest
from firmware_build import APT, require
from firmware_layout import CONSTANTS, FIELDS, MAILBOX_STATE, RESET_CAUSE, UWB_HEAD, UWB_STATE, UWB_TAIL

from services.balancer.core.devices import balboa, mailbox, uwb


def test_every_offset_is_the_same():
    assert {name: getattr(balboa, name) for name in FIELDS} == {name: field.offset for name, field in FIELDS.items()}


def test_every_constant_known_to_both_is_equal():
    only_there = {"REVISION_NUMBER", "MOTOR_TIMEOUT_MS"}
    shared = CONSTANTS.keys() - only_there
    assert {name: getattr(balboa, name) for name in shared} == {name: CONSTANTS[name] for name in shared}
    assert CONSTANTS["MOTOR_TIMEOUT_MS"] / 1000 == balboa.MOTOR_TIMEOUT_S


def test_every_state_has_the_same_number():
    for ours, theirs in ((uwb.UwbState, UWB_STATE), (mailbox.MailboxState, MAILBOX_STATE)):
        assert {state.name.lower(): state.value for state in ours} == theirs
    assert set(balboa.RESET_CAUSES) == set(RESET_CAUSE.values())


def test_the_drivers_formats_fit_the_fields():
    assert len(balboa.encode_motors(0.0, 0.0)) == FIELDS["MOTORS"].size
    assert len(balboa.encode_leds(False, False, False)) == FIELDS["LEDS"].size
    assert FIELDS["STATUS"].offset + 1 - FIELDS["ENCODERS"].offset == balboa.MOTION_SIZE
    assert FIELDS["UWB_STATE"].offset - FIELDS["BUTTONS"].offset == balboa.HOUSEKEEPING_SIZE
    assert FIELDS["NOTES_LEFT"].offset + 1 - FIELDS["UWB_STATE"].offset == balboa.PROGRESS_SIZE
    ranges = balboa.UWB_RANGES * (balboa.UWB_RANGE_SIZE + balboa.UWB_PLACE_SIZE)
    assert UWB_HEAD.size + balboa.UWB_PLACE_SIZE + ranges + UWB_TAIL.size == balboa.UWB_SIZE
    assert FIELDS["UWB"].size == balboa.UWB_SIZE


def test_fields_do_not_overlap_and_one_byte_reaches_them_all():
    spans = sorted((field.offset, field.offset + field.size) for field in FIELDS.values())
    assert all(end <= start for (_, end), (start, _) in itertools.pairwise(spans))
    assert spans[0][0] == 0
    assert spans[-1][1] <= balboa.JOINED, "the indices from there on are those of joined reads"


def test_the_head_and_the_ranges_of_a_report_can_be_joined_to_the_encoders():
    joined = {balboa.joined(offset) for offset in range(balboa.BUTTONS, balboa.LAST_JOINED + 1, 4)}
    assert joined <= set(range(balboa.JOINED + 1, balboa.ONWARD))
    assert balboa.LAST_JOINED // 4 + balboa.JOINED == balboa.ONWARD - 1
    assert balboa.UWB % 4 == 0


def test_version_2_is_where_it_always_was():
    """Robots in the field are found by these numbers, whatever else changes."""
    expected = {
        "VERSION": (0, 1),
        "LEDS": (1, 3),
        "MOTORS": (4, 4),
        "ENCODERS": (8, 4),
        "BUTTONS": (12, 1),
        "STATUS": (13, 1),
        "BATTERY": (14, 2),
        "UWB": (32, 100),
    }
    assert {name: FIELDS[name][:2] for name in expected} == expected


@pytest.mark.parametrize(("ci", "outcome"), [("", pytest.skip.Exception), ("true", pytest.fail.Exception)])
def test_missing_tools_are_named_with_what_to_install(monkeypatch, ci, outcome):
    """A user is told, continuous integration fails: nothing may be skipped there."""
    monkeypatch.setenv("CI", ci)
    with pytest.raises(outcome, match="no-such-compiler") as caught:
        require(("sh", "no-such-compiler"), ("/no/such/header.h",))
    assert APT in str(caught.value)
    require(("sh",))
