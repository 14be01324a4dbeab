"""The DWM1001's line: polls, reports, everything that can go wrong with an answer, and the mailbox."""

import itertools

import pytest
from conftest import examples
from firmware_layout import CONSTANTS, FIELDS, MAILBOX_STATE, UWB_STATE
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.dwm.core.module.tlv import AnchorRange, Location, Position, encode_location

pytest_plugins = ("firmware_fixtures",)

LOC_GET = b"\x0c\x00"
BYTE = 10 / 115200
GAP_LIMIT = 25 / 32768
"""The module drops a request with a pause longer than this in it (API guide, UART)."""

PLACE = Position(1.234, -2.5, 0.75, 87)


def location(count: int = 4, first: int = 0xC933) -> Location:
    anchors = (
        AnchorRange(f"{first + n:04X}", 1.5 + n, 80 + n, Position(float(n), 2.0 * n, -0.5, 100)) for n in range(count)
    )
    return Location(PLACE, tuple(anchors))


def as_reported(found: Location):
    """Place and ranges of the UWB block for `found`."""
    data = encode_location(found)
    records = [data[21 + 20 * n : 41 + 20 * n] for n in range(min(4, len(found.ranges)))]
    return data[5:18], tuple(records + [bytes(20)] * (4 - len(records)))


def state(bench) -> int:
    return bench.number("UWB_STATE")


def answer(bench, data: bytes) -> None:
    """Wait for a poll and answer it as the module would, 12 ms later."""
    assert bench.await_request() == LOC_GET
    bench.run(0.012)
    bench.feed(data)
    bench.run(len(data) * BYTE + 0.003)


def test_the_firmware_asks_the_module_ten_times_a_second_in_one_piece(bench):
    bench.run(2.0)
    sent = bench.sent()
    assert bytes(item.byte for item in sent) == LOC_GET * 20
    starts = [sent[i].at for i in range(0, 40, 2)]
    assert all(abs(b - a - 0.1) < 0.002 for a, b in itertools.pairwise(starts))
    assert all(sent[i + 1].at - sent[i].at < GAP_LIMIT for i in range(0, 40, 2))


def test_the_line_runs_at_115200_baud(bench):
    """From the registers (datasheet table 18-1): simavr counts eleven bits a byte."""
    double_speed = bench.call("data", 0xC8) & 2
    divider = bench.call("data", 0xCC) + 256 * bench.call("data", 0xCD) + 1
    baud = 16e6 / ((8 if double_speed else 16) * divider)
    assert baud == pytest.approx(115200, rel=0.022), "with the module's own error within the 4 % that 8N1 bears"
    assert bench.call("data", 0xCA) == 0b110, "8N1"


def test_before_any_answer_there_is_no_report(bench):
    bench.run(0.35)
    assert bench.report()[:3] == (0, 0xFFFF, 0)
    assert state(bench) == UWB_STATE["silent"]
    assert bench.number("UWB_BAD") == 0


@pytest.mark.parametrize("count", range(13))
def test_every_module_in_sight_is_reported_up_to_four(bench, count):
    found = location(count)
    answer(bench, encode_location(found))
    report = bench.report()
    assert (report.sequence, report.count) == (1, count)
    assert (report.place, report.ranges) == as_reported(found)
    assert state(bench) == UWB_STATE["ok"]


def test_sequence_and_age_tell_new_from_old(bench):
    for sequence in range(1, 6):
        answer(bench, encode_location(location(first=sequence)))
        report = bench.report()
        assert report.sequence == sequence
        assert report.age <= 20
    bench.run(1.0)
    report = bench.report()
    assert report.sequence == 5
    assert 1000 <= report.age <= 1025
    assert report.ranges == as_reported(location(first=5))[1], "what is old stays to be read"
    assert state(bench) == UWB_STATE["silent"]


def test_a_report_read_in_slices_stays_the_one_whose_first_byte_was_read(bench):
    """The next report comes between the slices of one."""
    answer(bench, encode_location(location(first=0x1000)))
    offset, size, _ = FIELDS["UWB"]
    first = bench.get_at(offset, 32)
    answer(bench, encode_location(location(first=0x2000)))
    rest = b"".join(bench.get_at(offset + at, min(32, size - at)) for at in range(32, size, 32))
    assert first[:2] == b"\1\0"
    assert rest[-2:] == b"\1\0"
    assert bench.get("STATUS")[0] >> 4 == 2, "that there is another one is to be seen"
    # In one transfer, or in several with one index, it is frozen.
    bench.write(CONSTANTS["ADDRESS"], bytes((offset,)))
    bench.run(1e-4)
    head = bench.read(CONSTANTS["ADDRESS"], 32)
    answer(bench, encode_location(location(first=0x3000)))
    tail = bench.read(CONSTANTS["ADDRESS"], size - 32)
    ranges = as_reported(location(first=0x2000))[1]
    assert (head + tail)[18:98] == b"".join(each[:7] for each in ranges) + b"".join(each[7:] for each in ranges)
    assert head[:2] == tail[-2:]


@pytest.mark.parametrize("pause", [0.001, 0.003])
def test_an_answer_that_arrives_in_pieces_is_taken_whole(bench, pause):
    data = encode_location(location())
    bench.await_request()
    for at in range(0, len(data), 17):
        bench.feed(data[at : at + 17])
        bench.run(17 * BYTE + pause)
    bench.run(0.003)
    assert bench.report().sequence == 1


@pytest.mark.parametrize("cut", [1, 2, 3, 5, 17, 19, 20, 40, 100])
def test_a_truncated_answer_is_told_and_costs_itself_only(bench, cut):
    data = encode_location(location())
    answer(bench, data[:cut])
    bench.run(0.09)
    assert bench.number("UWB_BAD") == 1
    assert bench.report().sequence == 0
    answer(bench, data)
    assert bench.report().sequence == 1
    assert bench.number("UWB_BAD") == 1


@pytest.mark.parametrize(
    "wrong",
    [
        bytes.fromhex("400100 410c") + bytes(12) + b"\x49\x01\x00",
        bytes.fromhex("400100 410d") + bytes(13) + b"\x49\x02\x00\x00",
        bytes.fromhex("400100 410d") + bytes(13) + b"\x49\x15\x02" + bytes(20),
        bytes.fromhex("400100 410d") + bytes(13) + b"\x49\x01\x01",
        bytes.fromhex("400100 410d") + bytes(12) + b"\x65\x49\x01\x00",
        bytes.fromhex("400100 410d") + bytes(13) + b"\x48\x01\x00",
        bytes.fromhex("400200 0041 0d") + bytes(13),
        bytes.fromhex("400106"),
        b"dwm> \r\n",
    ],
    ids=["place", "list", "count", "count-0", "percent", "anchor", "head", "code", "shell"],
)
def test_a_wrong_answer_is_no_report(bench, wrong):
    answer(bench, wrong)
    bench.run(0.09)
    assert bench.report().sequence == 0
    assert bench.number("UWB_BAD") == 1
    answer(bench, encode_location(location()))
    assert bench.report().sequence == 1


@pytest.mark.parametrize("code", [1, 2, 3, 4, 5])
def test_the_modules_error_is_passed_on(bench, code):
    answer(bench, bytes((0x40, 1, code)))
    assert state(bench) == UWB_STATE["refused"]
    assert bench.number("UWB_ERROR") == code
    assert bench.report().sequence == 0
    answer(bench, encode_location(location()))
    assert state(bench) == UWB_STATE["ok"]


@given(noise=st.binary(min_size=1, max_size=300))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(25), deadline=None)
def test_after_any_noise_the_next_answer_is_read(new_bench, noise):
    bench = new_bench()
    bench.run(0.02)
    answer(bench, noise)
    bench.run(0.08)
    bench.sent()
    before = bench.report().sequence
    bench.run(0.02)
    answer(bench, encode_location(location()))
    assert bench.report().sequence == before + 1
    assert (bench.report().place, bench.report().ranges) == as_reported(location())


def test_noise_without_end_starves_nothing(bench):
    """A line that floats: bytes without a pause, the motors' watchdog and the bus do not care."""
    bench.wheels(3000, 3000)
    for _ in range(8):
        bench.feed(bytes((0x40, 1, 0, 0x41, 0x0D)) * 40 + bytes(range(256)))
        for _ in range(4):
            bench.drive(100, 100)
            bench.get("ENCODERS")
            bench.run(0.009)
    assert bench.motors() == (0.25, 0.25)
    assert bench.i2c_stats().deaf == 0
    bench.wheels(0, 0)
    bench.run(0.4)
    assert bench.encoders() == bench.counts()
    bench.sent()
    answer(bench, encode_location(location()))
    assert bench.report().sequence >= 1
    assert bench.call("resets") == 0


# The mailbox


def ask(bench, request: bytes, token: int = 7) -> None:
    window = CONSTANTS["WINDOW_SIZE"]
    for page in range((len(request) + window - 1) // window):
        bench.put("MAILBOX_PAGE", bytes((page,)) + request[page * window :][:window])
    bench.put("MAILBOX_TOKEN", bytes((token, len(request))))


def mail(bench):
    """State, token and answer."""
    raw = bench.get_at(FIELDS["MAILBOX_STATE"].offset, 4)
    length = int.from_bytes(raw[2:], "little")
    data = b""
    while len(data) < length:
        bench.put("MAILBOX_PAGE", bytes((len(data) // 28,)))
        data += bench.get_at(FIELDS["MAILBOX_WINDOW"].offset, 28)
    return raw[0], raw[1], data[:length]


def until_not_busy(bench, limit):
    bench.run_until(lambda: bench.number("MAILBOX_STATE") != MAILBOX_STATE["busy"], limit)


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        (b"\x08\x00", bytes.fromhex("400100 46025010")),  # cfg_get
        (b"\x05\x02\x9a\x00", bytes.fromhex("400100")),  # cfg_tag_set
        (b"\x15\x00", bytes.fromhex("400100 500401000203 510400070000 52042a00cadc")),  # ver_get
        (b"\x32\x00", bytes.fromhex("400105")),  # refused
        (b"\x99" + bytes((253,)) + bytes(range(253)), bytes.fromhex("400101")),
        (b"\x0c\x00", encode_location(location(12))),
    ],
    ids=["cfg_get", "cfg_set", "ver_get", "refused", "longest", "loc_get-12"],
)
def test_any_request_and_its_answer_pass(bench, request_, reply):
    bench.run(0.01)
    ask(bench, request_, token=0x5A)
    assert mail(bench)[:2] == (MAILBOX_STATE["busy"], 0x5A)
    bench.run(0.003 + len(request_) * BYTE)
    assert bench.number("UWB_STATE") == UWB_STATE["paused"]
    sent = bench.sent()
    assert bytes(item.byte for item in sent) == request_
    assert max((b.at - a.at for a, b in itertools.pairwise(sent)), default=0.0) < GAP_LIMIT
    bench.run(0.03)
    bench.feed(reply)
    until_not_busy(bench, len(reply) * BYTE + 0.012)
    assert mail(bench) == (MAILBOX_STATE["answered"], 0x5A, reply)


def test_polling_pauses_for_the_mailbox_and_goes_on_after_it(bench):
    answer(bench, encode_location(location()))
    bench.sent()
    ask(bench, b"\x08\x00")
    assert bench.await_request() == b"\x08\x00"
    bench.run(0.3)
    assert bench.sent_bytes() == b"", "no poll while an answer may come"
    bench.feed(bytes.fromhex("400100 46025010"))
    assert bench.await_request() == LOC_GET
    bench.run(0.012)
    bench.feed(encode_location(location()))
    bench.run(0.012)
    assert bench.report().sequence == 2
    assert mail(bench)[2] == bytes.fromhex("400100 46025010"), "stays until the next request"


def test_a_request_waits_for_the_answer_of_a_poll(bench):
    bench.await_request()
    ask(bench, b"\x08\x00")
    bench.run(0.02)
    assert bench.sent_bytes() == b"", "one request at a time"
    bench.feed(encode_location(location()))
    bench.run(0.015)
    assert bench.report().sequence == 1
    assert bench.sent_bytes() == b"\x08\x00"


def test_no_answer_is_told_after_half_a_second(bench):
    ask(bench, b"\x14\x00")
    bench.await_request()
    start = bench.now
    until_not_busy(bench, 0.6)
    assert 0.49 < bench.now - start < 0.51
    assert mail(bench) == (MAILBOX_STATE["silent"], 7, b"")
    assert bench.await_request() == LOC_GET


@pytest.mark.parametrize(
    "reply",
    [b"\x40", bytes.fromhex("400100 460250"), b"dwm> unknown\r\n", b"\xff", bytes(400)],
    ids=["one-byte", "cut", "shell", "noise", "too-long"],
)
def test_what_is_no_answer_is_shown_as_it_came(bench, reply):
    ask(bench, b"\x08\x00")
    bench.await_request()
    bench.feed(reply)
    until_not_busy(bench, len(reply) * BYTE + 0.02)
    assert mail(bench) == (MAILBOX_STATE["broken"], 7, reply[:280])


def test_what_a_module_in_shell_mode_echoes_is_no_answer(bench):
    """Two carriage returns wake its shell, and let the Pi find out that it is in the wrong mode."""
    for page, byte in enumerate(b"abc"):
        bench.put("MAILBOX_PAGE", bytes((page,)) + bytes((byte,)) * 28)
    bench.put("MAILBOX_TOKEN", bytes((3, 84)))
    bench.run(0.001)
    bench.feed(b"?" * 60)
    bench.run(84 * BYTE + 0.002)
    assert bench.sent_bytes() == b"a" * 28 + b"b" * 28 + b"c" * 28, "the request was not overwritten while it was sent"
    bench.feed(b"unknown")
    until_not_busy(bench, 0.02)
    assert mail(bench) == (MAILBOX_STATE["broken"], 3, b"unknown")


def test_a_busy_mailbox_cannot_be_written(bench):
    ask(bench, b"\x08\x00")
    for field, data in (("MAILBOX_TOKEN", b"\1\2"), ("MAILBOX_PAGE", b"\1"), ("MAILBOX_WINDOW", b"\0")):
        with pytest.raises(OSError, match="I/O"):
            bench.put(field, data)
        bench.run(2e-4)
    assert bench.await_request() == b"\x08\x00"
    until_not_busy(bench, 0.6)
    ask(bench, b"\x15\x00", token=8)
    bench.run(0.2)
    assert bench.sent_bytes().removeprefix(LOC_GET) == b"\x15\x00"


def test_control_goes_on_while_the_mailbox_is_used(bench):
    bench.wheels(5000, 5000)
    bench.i2c_stats()
    ask(bench, b"\x99" + bytes((253,)) + bytes(253))
    asked = 0
    for _ in range(30):
        bench.drive(100, -100)
        bench.get("ENCODERS")
        bench.run(0.008)
        asked += len(bench.sent())
        if asked == 255:
            bench.feed(bytes((0x40, 1, 0, 0x77, 250)) + bytes(250))
            asked += 1
    assert mail(bench)[0] == MAILBOX_STATE["answered"]
    stats = bench.i2c_stats()
    assert stats.deaf == 0
    assert stats.stretch_longest < 50e-6
