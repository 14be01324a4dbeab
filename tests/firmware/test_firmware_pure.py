"""The firmware's parts without hardware, on this machine: protocol, hand-over of reports, parser, notes, encoders."""

import math

import pytest
from conftest import examples
from firmware_layout import CONSTANTS, FIELDS, MAILBOX_STATE
from firmware_pure import LOCATION, Pure
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.balancer.core.devices import balboa
from services.dwm.core.module.tlv import (
    LOC_GET,
    AnchorRange,
    Location,
    Position,
    TlvDecoder,
    encode_location,
)
from swarm.errors import FrameError

pytest_plugins = ("firmware_fixtures",)

ONE_COPY = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(60), deadline=None
)
"""The parts are used again and again in one test, as on the chip."""

coordinates = st.integers(-(2**31), 2**31 - 1).map(lambda mm: mm / 1000)
percents = st.integers(0, 100)
places = st.builds(Position, coordinates, coordinates, coordinates, percents)
addresses = st.integers(0, 0xFFFF).map("{:04X}".format)
distances = st.integers(0, 2**32 - 1).map(lambda mm: mm / 1000)
ranges = st.builds(AnchorRange, addresses, distances, percents, places)
locations = st.builds(Location, places, st.lists(ranges, max_size=12).map(tuple))


def plain(location: Location) -> tuple[bytes, tuple[bytes, ...]]:
    """As the firmware keeps it."""
    data = encode_location(location)
    return data[5:18], tuple(data[21 + 20 * n : 41 + 20 * n] for n in range(len(location.ranges)))


# The I2C protocol


def test_a_write_is_applied_at_stop_and_not_before(pure):
    assert pure.write(FIELDS["LEDS"].offset, b"\1\0\1", stop=False) == 3
    assert pure.front(1, 3) == b"\0\0\0"
    pure.slave_stopped()
    assert pure.front(1, 3) == b"\1\0\1"


def test_a_write_across_two_fields_is_one(pure):
    assert pure.write(1, b"\1\1\1\x10\0\x20\0") == 7
    assert pure.front(1, 7) == b"\1\1\1\x10\0\x20\0"
    assert pure.pure_motor_writes() == 1


def test_leds_alone_do_not_feed_the_motor_watchdog(pure):
    pure.write(1, b"\1\1\1")
    assert pure.pure_motor_writes() == 0


def test_an_index_alone_changes_nothing(pure):
    before = pure.front(0, 32)
    for index in range(256):
        assert pure.write(index) == 0
    assert pure.front(0, 32) == before


@given(index=st.integers(0, 255), data=st.binary(min_size=1, max_size=40))
@ONE_COPY
def test_no_write_reaches_what_belongs_to_the_firmware(pure, index, data):
    mine = [FIELDS[name] for name in FIELDS if FIELDS[name].writer == "firmware" and FIELDS[name].offset < 32]
    own = {"REFUSED", "NOTES_LEFT", "MAILBOX_STATE", "MAILBOX_ECHO", "MAILBOX_LENGTH"}
    quiet = [f for f in mine if f not in {FIELDS[name] for name in own}]
    before = [pure.front(field.offset, field.size) for field in quiet]
    pure.write(index, data)
    assert [pure.front(field.offset, field.size) for field in quiet] == before


@given(index=st.integers(0, 255), data=st.binary(min_size=1, max_size=40))
@ONE_COPY
def test_a_write_that_does_not_fit_is_refused_whole_at_the_first_byte_too_many(pure, index, data):
    pure.pure_set_front(FIELDS["MAILBOX_STATE"].offset, MAILBOX_STATE["empty"])
    rooms = [range(1, 8), range(144, 146), range(160, 191), range(192, 194), range(194, 223)]
    whole = {144: 2, 160: 31, 192: 2}
    room = next((len(r) - (index - r.start) for r in rooms if index in r), 0)
    if any(index in r for r in rooms[1:4]):
        room = whole.get(index, 0)
    if FIELDS["MOTORS"].offset < index < FIELDS["ENCODERS"].offset:
        room = 0  # the motors' numbers are written together
    before, refused = pure.front(1, 7), pure.front(22, 1)
    assert pure.write(index, data) == min(len(data), room)
    if len(data) > room:
        assert pure.front(1, 7) == before
        assert pure.front(22, 1)[0] == (refused[0] + 1) % 256


def test_a_read_is_of_the_moment_of_its_index(pure):
    offset = FIELDS["ENCODERS"].offset
    for at in range(4):
        pure.pure_set_front(offset + at, 0x11)
    pure.write(offset)
    for at in range(4):
        pure.pure_set_front(offset + at, 0x22)
    assert pure.read(2) + pure.read(2) == b"\x11" * 4
    assert pure.read_at(offset, 4) == b"\x22" * 4


@given(index=st.integers(0, balboa.JOINED - 1), count=st.integers(1, 300))
@ONE_COPY
def test_reading_beyond_the_end_gives_zeros(pure, index, count):
    data = pure.read_at(index, count)
    assert not any(data[255 - index :])


# Reports


def test_before_the_first_report_there_is_none(pure):
    assert pure.read_at(32, 5) == b"\0\0\xff\xff\0"


def test_age_counts_from_the_report_to_the_index_and_saturates(pure):
    pure.report_fill(7)
    pure.report_publish(1000)
    for now, age in ((1000, 0), (1001, 1), (66535, 65535), (66536, 65535), (10_000_000, 65535)):
        pure.pure_time(now)
        assert pure.read_at(32, 4) == b"\1\0" + age.to_bytes(2, "little")


@given(steps=st.lists(st.sampled_from(["fill", "publish", "freeze", "read"]), max_size=60))
@ONE_COPY
def test_a_report_is_never_torn(pure, steps):
    """Whatever the order in which the main loop writes and the master looks."""
    for value, step in enumerate(steps):
        if step == "fill":
            pure.report_fill(value)
        elif step == "publish":
            pure.report_publish(value)
            pure.report_fill(value)
        elif step == "freeze":
            pure.write(32)
            frozen = pure.read(100)
        elif "freeze" in steps[:value]:
            head, tail, body = frozen[:2], frozen[98:], frozen[4:98]
            assert head == tail
            assert len(set(body)) == 1


def test_sequence_numbers_leave_out_0(pure):
    for _ in range(65535):
        pure.report_publish(0)
    assert pure.read_at(32, 2) == b"\xff\xff"
    pure.report_publish(0)
    assert pure.read_at(32, 2) == b"\1\0"


# Mailbox


def test_a_request_goes_in_page_by_page_and_comes_out(pure):
    request = bytes(range(255))
    for page in range(10):
        part = request[28 * page : 28 * page + 28]
        assert pure.write(194, bytes((page,)) + part) == 1 + len(part)
    assert bytes(pure.mailbox_byte(at) for at in range(255)) == request
    for page in range(10):
        pure.write(194, bytes((page,)))
        assert pure.read_at(194, 29) == bytes((page,)) + request[28 * page :][:28].ljust(28, b"\0")
    assert pure.write(192, b"\x2a\xff") == 2
    assert pure.mailbox_request() == 255
    assert pure.front(28, 4) == bytes((MAILBOX_STATE["busy"], 0x2A, 0, 0))


def test_a_busy_mailbox_refuses_everything(pure):
    pure.write(192, b"\1\2")
    for index in range(192, 223):
        assert pure.write(index, b"\5") == 0
    assert pure.mailbox_request() == 2


def test_no_such_page_no_empty_request(pure):
    for refused, (index, data) in enumerate(((194, b"\x0a"), (194, b"\xff\1"), (192, b"\1\0"), (192, b"\1")), 1):
        assert pure.write(index, data) == len(data)
        assert pure.front(22, 1)[0] == refused
    assert pure.front(28, 1) == b"\0"


def test_only_the_whole_bootloader_command_counts(pure):
    assert pure.write(144, b"\x07\xb0") == 2
    assert pure.pure_last_command() == 0xB007 == CONSTANTS["BOOTLOADER_COMMAND"]
    assert pure.front(22, 1) == b"\0"
    for wrong in (b"\x07", b"\x07\xb1", b"\xb0\x07"):
        refused = pure.front(22, 1)[0]
        pure.write(144, wrong)
        assert pure.front(22, 1)[0] == refused + 1


# The answer to loc_get


@given(location=locations)
@ONE_COPY
def test_what_the_services_encoder_writes_the_firmware_reads(pure, location):
    pure.location_reset()
    assert pure.locations(encode_location(location)) == [plain(location)]


@given(found=st.lists(locations, min_size=1, max_size=4), noise=st.data())
@ONE_COPY
def test_the_parser_finds_answers_after_noise(pure, found, noise):
    pure.location_reset()
    stream, expected = b"", []
    for location in found:
        # Noise that begins an answer is for the next test.
        stream += bytes(b for b in noise.draw(st.binary(max_size=40)) if b != 0x40) + encode_location(location)
        expected.append(plain(location))
    assert pure.locations(stream) == expected


@given(first=locations, second=locations, cut=st.integers(1, 260))
@ONE_COPY
def test_an_answer_that_was_cut_off_costs_itself_only(pure, first, second, cut):
    pure.location_reset()
    # With less missing, the beginning of the second would complete the first; but there is silence between polls.
    half = encode_location(first)[:-5][:cut]
    assert pure.locations(half + encode_location(second)) == [plain(second)]


@given(data=st.binary(max_size=600), location=locations)
@ONE_COPY
def test_the_parser_never_accepts_what_the_services_decoder_refuses(pure, data, location):
    """Both are built on the same rules, by different hands: what the firmware accepts must be a true answer."""
    pure.location_reset()
    stream = bytearray(encode_location(location) * 2)
    for at, value in enumerate(data):
        stream[(value * 7 + at * 13) % len(stream)] ^= value
    for found in pure.locations(bytes(stream)):
        if isinstance(found, int):
            assert 1 <= found <= 5
            continue
        place, records = found
        again = bytes((0x40, 1, 0, 0x41, 13)) + place + bytes((0x49, 1 + 20 * len(records), len(records)))
        decoder = TlvDecoder(LOC_GET)
        decoder.receive(again + b"".join(records))
        assert isinstance(decoder.next(), Location)


@pytest.mark.parametrize("error", [1, 2, 3, 4, 5])
def test_refusals_are_told_from_answers(pure, error):
    assert pure.locations(bytes((0x40, 1, error))) == [error]
    assert not pure.location_begun()


@pytest.mark.parametrize(
    ("at", "value"),
    [(2, 6), (3, 0x42), (4, 12), (17, 101), (18, 0x48), (19, 22), (19, 253), (20, 2), (27, 101), (40, 255)],
)
def test_each_byte_that_must_hold_is_checked(pure, at, value):
    place = Position(1.0, 2.0, 3.0, 90)
    frame = bytearray(encode_location(Location(place, (AnchorRange("C933", 1.5, 95, place),))))
    frame[at] = value
    decoder = TlvDecoder(LOC_GET)
    decoder.receive(bytes(frame))
    try:
        reference = decoder.next()
    except FrameError:
        reference = None
    assert not isinstance(reference, Location)
    assert not any(isinstance(found, tuple) for found in pure.locations(bytes(frame)))


def test_noise_of_all_heads_is_no_trap(pure):
    """The worst case for going back: bytes that begin an answer again and again."""
    place = Position(1.0, 2.0, 3.0, 90)
    frame = encode_location(Location(place, ()))
    assert pure.locations(frame[:17] * 30 + b"\xff" + frame)[-1] == plain(Location(place, ()))


@given(data=st.binary(max_size=40), parts=st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=5))
@ONE_COPY
def test_an_answer_of_whole_parts_is_known_from_anything_else(pure, data, parts):
    whole = b"\x40\1\0" + b"".join(bytes((kind, len(value))) + value for kind, value in parts)
    assert pure.whole(whole)
    assert pure.whole(b"\x40\1\3")
    if parts:
        assert not pure.whole(whole[:-1])
        assert not pure.whole(b"\x40\1\3" + whole[3:])
    assert not pure.whole(whole + b"\1")
    assert not pure.whole(b"\x0c\0" + data)


# Notes


@pytest.mark.parametrize("pitch", range(12, 120))
def test_every_note_is_in_tune(pure, pitch):
    frequency = 16e6 / (2 * 2 ** (pure.tone_prescaler(pitch) - 1) * pure.tone_top(pitch))
    wanted = 440.0 * 2 ** ((pitch - 69) / 12)
    assert abs(1200 * math.log2(frequency / wanted)) < 2.0, "cents"
    assert pure.tone_top(pitch) < 1024


def test_what_is_no_note_is_a_rest(pure):
    assert {pure.tone_top(pitch) for pitch in (0, 11, 120, 255)} == {0}


def test_each_step_of_volume_doubles(pure):
    compares = [pure.tone_compare(512, volume) for volume in range(17)]
    assert compares == [0] + [512 >> (16 - volume) for volume in range(1, 16)] + [256]


def play(pure: Pure, ticks: int) -> list[int]:
    """The pitch that sounds in each millisecond."""
    sounding = []
    for _ in range(ticks):
        pure.tune_tick()
        sounding.append(pure.tune_pitch())
    return sounding


def test_notes_last_as_long_as_they_say(pure):
    assert pure.load_tune(bytes((15, 60, 2, 0, 1, 64, 3)))
    assert pure.tune_left() == 3
    assert play(pure, 62) == [60] * 20 + [0] * 10 + [64] * 30 + [0, 0]
    assert pure.tune_left() == 0


def test_a_new_tune_takes_over_and_an_empty_one_ends_it(pure):
    pure.load_tune(bytes((15, 60, 200)))
    assert play(pure, 5) == [60] * 5
    pure.load_tune(bytes((15, 62, 200)))
    assert play(pure, 5) == [62] * 5
    pure.load_tune(bytes((0,)))
    assert pure.tune_tick(), "the buzzer must be told"
    assert play(pure, 3) == [0] * 3


def test_notes_of_no_length_are_left_out_and_half_a_note_is_none(pure):
    assert pure.load_tune(bytes((15, 60, 0, 61, 0, 62, 1)))
    assert play(pure, 12) == [62] * 10 + [0] * 2
    assert not pure.load_tune(bytes((15, 60)))


@given(pairs=st.lists(st.tuples(st.integers(0, 255), st.integers(0, 20)), max_size=15), volume=st.integers(0, 255))
@ONE_COPY
def test_a_tune_is_as_long_as_its_notes(pure, pairs, volume):
    flat = bytes(value for pair in pairs for value in pair)
    assert pure.load_tune(bytes((volume,)) + flat)
    total = sum(10 * duration for _, duration in pairs)
    left = [pure.tune_left() for _ in range(total + 2) if pure.tune_tick() is not None]
    assert left == sorted(left, reverse=True)
    assert left[-1] == 0
    assert total == 0 or left[total - 1] >= 1


# Encoders


@given(moves=st.lists(st.sampled_from((-1, 1)), max_size=200))
@ONE_COPY
def test_every_edge_is_one_count(pure, moves):
    channels = [(False, False), (False, True), (True, True), (True, False)]  # A, B: forward is B first
    place, pairs = 0, []
    for move in moves:
        place += move
        a, b = channels[place % 4]
        pairs.append((a != b, b))
    assert pure.quadrature(pairs) == (place, 0)


def test_a_missed_edge_is_an_error_and_no_count(pure):
    assert pure.quadrature([(True, True), (True, False), (False, False)]) == (2, 1), "one before, one after"


def test_location_is_the_name_the_library_gives_it(pure):
    """The numbers of the enumeration cross the language border."""
    frame = encode_location(Location(Position(0.0, 0.0, 0.0, 0), ()))
    assert [pure.location_feed(byte) for byte in frame] == [0] * (len(frame) - 1) + [LOCATION]
