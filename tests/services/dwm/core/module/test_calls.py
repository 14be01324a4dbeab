"""The calls besides loc_get: golden bytes of the API guide's tables, and what must hold of all of them."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.module import calls
from services.dwm.core.module.calls import ModuleStatus, Settings, UpdateRate, Version
from services.dwm.core.module.tlv import (
    LOC_GET,
    OK,
    Position,
    Refusal,
    TlvDecoder,
    encode_part,
    encode_position,
    encode_refusal,
)
from swarm.errors import FrameError, LocalError
from swarm.messages.devices import MODULE_CALLS

PLACE = Position(1.0, -0.5, 0.123, 100)
SETTINGS = st.builds(
    Settings,
    anchor=st.booleans(),
    initiator=st.booleans(),
    bridge=st.booleans(),
    low_power=st.booleans(),
    engine=st.booleans(),
    stationary=st.booleans(),
    encrypted=st.booleans(),
    leds=st.booleans(),
    bluetooth=st.booleans(),
    update=st.booleans(),
    uwb=st.integers(0, 2),
    measurement=st.integers(0, 3),
)


def answer(call, data):
    decoder = TlvDecoder(call)
    decoder.receive(data)
    result = decoder.next()
    assert decoder.raw == data
    return result


@pytest.mark.parametrize(
    ("call", "request_"),
    [
        (calls.pos_set(PLACE), "01 0d e8030000 0cfeffff 7b000000 64"),
        (calls.POS_GET, "02 00"),
        (calls.upd_rate_set(UpdateRate(1, 100)), "03 04 0100 6400"),
        (calls.UPD_RATE_GET, "04 00"),
        # LEDs, Bluetooth, active, location engine: a tag without low power and stationary detection
        (calls.cfg_set(Settings(anchor=False)), "05 02 5a 00"),
        (calls.cfg_set(Settings(False, low_power=True, stationary=True, encrypted=True, update=True)), "05 02 fe 04"),
        (calls.cfg_set(Settings(anchor=True)), "07 02 1a 00"),
        (calls.cfg_set(Settings(anchor=True, initiator=True, bridge=True)), "07 02 da 00"),
        (calls.CFG_GET, "08 00"),
        (LOC_GET, "0c 00"),
        (calls.RESET, "14 00"),
        (calls.VER_GET, "15 00"),
        (calls.NODE_ID_GET, "30 00"),
        (calls.STATUS_GET, "32 00"),
    ],
)  # fmt: skip
def test_requests_have_the_bytes_of_the_api_guide(call, request_):
    assert call.request == bytes.fromhex(request_)
    assert calls.call_of(call.request).name == call.name


@pytest.mark.parametrize(
    ("call", "data", "result"),
    [
        (calls.POS_GET, "400100 410d e8030000 0cfeffff 7b000000 64", PLACE),
        (calls.UPD_RATE_GET, "400100 4504 0100 6400", UpdateRate(1, 100)),
        (calls.CFG_GET, "400100 4602 5a 00", Settings(anchor=False)),
        (calls.CFG_GET, "400100 4602 5a 04", Settings(anchor=False, stationary=True)),
        (calls.CFG_GET, "400100 4602 1a 30", Settings(anchor=True, initiator=True, engine=False)),
        # 1.3.0 variant 1, as `si` prints x01030001 x00010700
        (calls.VER_GET, "400100 5004 01000301 5104 00070100 5204 2a00cade",
         Version((1, 3, 0, 1), 0x00010700, 0xDECA002A)),
        (calls.NODE_ID_GET, "400100 4e08 1a59a2c0ab9acade", 0xDECA9AABC0A2591A),
        (calls.STATUS_GET, "400100 5a02 0300", ModuleStatus(located=True, joined=True)),
        (calls.STATUS_GET, "400100 5a01 01", ModuleStatus(located=True, joined=False)),  # PANS R1
        (calls.RESET, "400100", None),
        (calls.cfg_set(Settings(anchor=True)), "400100", None),
        (calls.CFG_GET, "400105", Refusal(5)),
    ],
)  # fmt: skip
def test_answers_are_read_as_the_api_guide_has_them(call, data, result):
    assert answer(call, bytes.fromhex(data)) == result


def test_the_version_is_told_as_the_maker_does():
    assert Version((1, 3, 0, 1), 0, 0).text == "1.3.0"


@given(SETTINGS)
def test_settings_survive_encoding(settings):
    data = encode_refusal(OK) + encode_part(calls.CONFIG, calls.encode_settings(settings))
    assert answer(calls.CFG_GET, data) == settings


@given(SETTINGS)
def test_what_is_set_is_what_the_module_is_asked_for(settings):
    request = calls.cfg_set(settings).request
    read = (calls.decode_anchor if settings.anchor else calls.decode_tag)(request[2:])
    common = ("anchor", "encrypted", "leds", "bluetooth", "update", "uwb")
    own = ("initiator", "bridge") if settings.anchor else ("low_power", "engine", "stationary", "measurement")
    for name in (*common, *own):
        assert getattr(read, name) == getattr(settings, name)


@given(st.integers(1, calls.SLOWEST), st.integers(1, calls.SLOWEST))
def test_update_rates_survive_encoding(moving, still):
    rate = UpdateRate(moving, still)
    assert calls.decode_rate(calls.upd_rate_set(rate).request[2:]) == rate
    assert answer(calls.UPD_RATE_GET, encode_refusal(OK) + calls.encode_rate(rate)) == rate


@given(st.tuples(*[st.integers(0, 255)] * 3, st.integers(0, 15)), *[st.integers(0, 2**32 - 1)] * 2)
def test_versions_survive_encoding(firmware, config, hardware):
    version = Version(firmware, config, hardware)
    assert answer(calls.VER_GET, encode_refusal(OK) + calls.encode_version(version)) == version


@pytest.mark.parametrize("rate", [UpdateRate(0, 1), UpdateRate(1, 0), UpdateRate(1, 601)])
def test_a_rate_the_module_does_not_know_is_not_asked_for(rate):
    with pytest.raises(LocalError, match=r"expected 0.1 to 60 s"):
        calls.upd_rate_set(rate)


def test_a_place_too_far_away_is_not_set():
    with pytest.raises(LocalError, match="position"):
        calls.pos_set(Position(3e6, 0, 0, 100))


@pytest.mark.parametrize("request_", ["", "13 00", "0a 00", "05 02 5a", "05 03 5a 00 00", "0c 01 03", "3c 10", "ff"])
def test_other_calls_are_not_let_through(request_):
    with pytest.raises(FrameError, match="let through"):
        calls.call_of(bytes.fromhex(request_))


@given(st.binary(max_size=40))
def test_any_request_is_a_call_or_none(data):
    try:
        call = calls.call_of(data)
    except FrameError:
        return
    assert call.request == data


def test_a_position_survives_encoding():
    assert answer(calls.POS_GET, encode_refusal(OK) + encode_part(0x41, encode_position(PLACE))) == PLACE


def test_dwm_and_balancer_let_the_same_calls_through() -> None:
    """A program may ask either of them, and the way through the ATmega must not lead to a factory reset."""
    passed = {}
    for kind in range(256):
        for length in range(16):
            with contextlib.suppress(FrameError):
                calls.call_of(bytes((kind, length)) + bytes(length))
                passed[kind] = length
    assert passed == MODULE_CALLS
