import pytest
from dwm_frames import EMPTY, GOLDEN, LOCATION, POSITION_BYTES
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.module.tlv import (
    ERRORS,
    LOC_GET,
    MAX_RANGES,
    AnchorRange,
    Location,
    Position,
    Refusal,
    TlvDecoder,
    encode_location,
    encode_refusal,
)
from swarm.errors import FrameError, LocalError

millimetres = st.integers(-(2**31), 2**31 - 1).map(lambda value: value / 1000)
percents = st.integers(0, 100)
positions = st.builds(Position, millimetres, millimetres, millimetres, percents)
ranges = st.builds(
    AnchorRange,
    st.integers(0, 0xFFFF).map(lambda value: f"{value:04X}"),
    st.integers(0, 2**32 - 1).map(lambda value: value / 1000),
    percents,
    positions,
)
# Numbers of rooms, not of the whole range of the fields: they do not look like the head of an answer.
rooms = st.integers(-30_000, 30_000).map(lambda value: value / 1000)
places = st.builds(Position, rooms, rooms, rooms, percents)
locations = st.builds(
    Location,
    places,
    st.lists(
        st.builds(AnchorRange, st.just("C933"), st.integers(0, 30_000).map(lambda mm: mm / 1000), percents, places),
        max_size=4,
    ).map(tuple),
)


def drain(decoder):
    """What the decoder makes of its bytes; errors are counted, anything but FrameError is a failure."""
    results, errors = [], 0
    while True:
        try:
            result = decoder.next()
        except FrameError:
            errors += 1
            continue
        if result is None:
            return results, errors
        results.append(result)


def decode(data):
    decoder = TlvDecoder(LOC_GET)
    decoder.receive(data)
    return drain(decoder)


def test_the_example_of_the_api_guide():
    assert LOC_GET.request == bytes.fromhex("0c00")
    assert GOLDEN[5:18] == POSITION_BYTES
    assert len(GOLDEN) == 101
    assert decode(GOLDEN) == ([LOCATION], 0)
    assert encode_location(LOCATION) == GOLDEN


def test_a_tag_that_sees_no_anchor():
    data = bytes.fromhex("400100 410d 00000000 00000000 00000000 00 4901 00")
    assert len(data) == 21
    assert decode(data) == ([EMPTY], 0)
    assert encode_location(EMPTY) == data


@pytest.mark.parametrize("code", ERRORS)
def test_error_codes_have_names(code):
    results, errors = decode(encode_refusal(code))
    assert (results, errors) == ([Refusal(code)], 0)
    assert results[0].name == ERRORS[code]


@given(st.builds(Location, positions, st.lists(ranges, max_size=MAX_RANGES).map(tuple)))
def test_a_location_is_decoded_as_it_was_encoded(location):
    assert decode(encode_location(location)) == ([location], 0)


@given(st.lists(locations, min_size=1, max_size=4), st.data())
def test_answers_are_decoded_however_their_bytes_are_split(sent, data):
    stream = b"".join(encode_location(location) for location in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    decoder, results = TlvDecoder(LOC_GET), []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        decoder.receive(stream[start:end])
        results += drain(decoder)[0]
    assert results == sent


@given(st.lists(st.tuples(st.binary(max_size=40), locations), min_size=1, max_size=4))
def test_noise_between_answers_costs_no_answer(pieces):
    pieces = [(noise.replace(b"\x40", b"\x20"), location) for noise, location in pieces]
    stream = b"".join(noise + encode_location(location) for noise, location in pieces)
    results, errors = decode(stream)
    assert results == [location for _, location in pieces]
    assert errors == 0


@given(st.binary(max_size=40), locations)
def test_any_noise_costs_no_later_answer(noise, location):
    results, _ = decode(noise + encode_location(location))
    assert results[-1] == location


@given(locations, locations, st.data())
def test_a_truncated_answer_costs_only_itself(first, second, data):
    whole = encode_location(first)
    length = data.draw(st.integers(0, len(whole) - 1))
    results, _ = decode(whole[:length] + encode_location(second))
    assert results == [second]


@given(st.lists(locations, min_size=1, max_size=3), st.data())
def test_mutations_raise_only_frame_errors_and_cost_one_answer(sent, data):
    stream = bytearray(b"".join(encode_location(location) for location in sent))
    for _ in range(data.draw(st.integers(1, 8))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    decoder = TlvDecoder(LOC_GET)
    decoder.receive(bytes(stream))
    drain(decoder)
    # A mutated length may have us wait for bytes: the next whole answer, at the latest, comes through.
    decoder.receive(encode_location(LOCATION))
    assert drain(decoder)[0][-1] == LOCATION


@given(st.binary(max_size=600))
def test_the_decoder_survives_any_bytes(data):
    decoder = TlvDecoder(LOC_GET)
    decoder.receive(data)
    drain(decoder)


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (3, 0x48, "part of type 48, expected 41"),
        (4, 0x0C, "part 41 of 12 bytes"),
        (17, 101, "position quality of 101 %"),
        (18, 0x4A, "part of type 4A, expected 49 or 48"),
        (19, 0x52, "part 49 of 82 bytes"),
        (19, 0x3D, "4 ranges announced in a part of 61 bytes"),
        (20, 5, "5 ranges announced in a part of 81 bytes"),
        (27, 255, "range quality of 255 %"),
    ],
)
def test_what_cannot_be_true_is_named(at, value, message):
    data = bytearray(GOLDEN)
    data[at] = value
    decoder = TlvDecoder(LOC_GET)
    decoder.receive(bytes(data))
    with pytest.raises(FrameError, match=message):
        decoder.next()
    decoder.receive(GOLDEN)
    assert drain(decoder)[0][-1] == LOCATION


def test_reset_forgets_half_an_answer():
    decoder = TlvDecoder(LOC_GET)
    decoder.receive(GOLDEN[:50])
    assert drain(decoder) == ([], 0)
    decoder.reset()
    assert decoder.skipped == 50
    decoder.receive(GOLDEN[50:] + GOLDEN)
    assert drain(decoder)[0] == [LOCATION]


@pytest.mark.parametrize(
    "location",
    [
        Location(Position(3e6, 0, 0, 100), ()),
        Location(EMPTY.position, LOCATION.ranges * 4),
        Location(EMPTY.position, (AnchorRange("C933", -1.0, 100, EMPTY.position),)),
        Location(EMPTY.position, (AnchorRange("target", 1.0, 100, EMPTY.position),)),
    ],
)
def test_what_no_module_can_say_is_not_encoded(location):
    with pytest.raises(LocalError):
        encode_location(location)
