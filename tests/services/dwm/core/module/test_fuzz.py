"""Mutated byte streams through each parser: nothing but the remote-error leaf, and in step again within one frame.

The short run is part of every test run, the long one is run by `-m slow`.
"""

import contextlib
import random

import pytest
from dwm_frames import LOCATION

from services.dwm.core.module import calls
from services.dwm.core.module.calls import Settings, UpdateRate
from services.dwm.core.module.exchange import ModuleExchange
from services.dwm.core.module.tlv import (
    LOC_GET,
    OK,
    Location,
    Position,
    TlvDecoder,
    encode_location,
    encode_part,
    encode_refusal,
)
from sim.core.dwm1001 import VERSION, Dwm1001, Flash
from swarm.errors import FrameError

SHORT, LONG = 2_000, 200_000
ANCHOR_ANSWER = Location(Position(1.0, 2.0, 0.5, 100), LOCATION.ranges[:2])
OKAY = encode_refusal(OK)
# A good answer to each call: what is mutated, and what must come through whole behind the mutated one.
ANSWERS = [
    (LOC_GET, encode_location(LOCATION)),
    (LOC_GET, encode_location(ANCHOR_ANSWER, anchor=True)),
    (calls.POS_GET, OKAY + encode_part(0x41, bytes(12) + b"\x64")),
    (calls.CFG_GET, OKAY + encode_part(calls.CONFIG, b"\x5a\x04")),
    (calls.UPD_RATE_GET, OKAY + calls.encode_rate(UpdateRate(1, 100))),
    (calls.VER_GET, OKAY + calls.encode_version(VERSION)),
    (calls.NODE_ID_GET, OKAY + encode_part(calls.NODE_ID, bytes(range(8)))),
    (calls.STATUS_GET, OKAY + encode_part(calls.STATUS, b"\x03\x00")),
    (calls.RESET, OKAY),
]


def runs(count):
    return pytest.param(count, marks=[pytest.mark.slow, pytest.mark.timeout(3600)] if count == LONG else [])


def mutated(data, generator):
    """Bytes changed, left out, put in or doubled; a piece cut off, or another one before it."""
    out = bytearray(data)
    for _ in range(generator.randint(1, 4)):
        at = generator.randrange(len(out) + 1)
        kind = generator.randrange(6)
        if kind == 0 and at < len(out):
            out[at] = generator.randrange(256)
        elif kind == 1:
            del out[at : at + generator.randint(1, 8)]
        elif kind == 2:
            out[at:at] = generator.randbytes(generator.randint(1, 8))
        elif kind == 3:
            out[at:at] = out[at : at + 20]
        elif kind == 4:
            del out[at:]
        elif at < len(out):
            out[at] ^= 1 << generator.randrange(8)
    return bytes(out)


@pytest.mark.parametrize("count", [runs(SHORT), runs(LONG)])
def test_random_answers_are_read_or_refused(count):
    generator = random.Random(1)
    for _ in range(count):
        call, good = ANSWERS[generator.randrange(len(ANSWERS))]
        decoder = TlvDecoder(call)
        decoder.receive(mutated(good, generator))
        # One frame behind the broken one may be lost to it; the next one is not.
        decoder.receive(good * 2)
        last, decoder.raw = b"", b"more"
        while decoder.raw:
            last, decoder.raw = decoder.raw, b""
            with contextlib.suppress(FrameError):
                decoder.next()
                continue
            decoder.raw = last  # there is more behind what was wrong
        assert last == good


@pytest.mark.parametrize("count", [runs(SHORT), runs(LONG)])
def test_random_exchanges_end_with_an_answer_or_a_trouble(count):
    """Whatever the line brings, a request ends with an answer or a named trouble."""
    generator = random.Random(2)
    for _ in range(count):
        call, good = ANSWERS[generator.randrange(len(ANSWERS))]
        exchange = ModuleExchange(call)
        data = mutated(good, generator)
        outcome = exchange.receive(data[: len(data) // 2]) or exchange.receive(data[len(data) // 2 :])
        if outcome is None:
            trouble = exchange.expire()
            assert trouble.kind in ("silent", "garbled", "shell", "layout")
            assert trouble.reason


@pytest.mark.parametrize("count", [runs(SHORT), runs(LONG)])
def test_changed_requests_to_a_module_are_answered_or_refused(count):
    """The simulated module's parser of requests, and the check of those that come over the bus."""
    generator = random.Random(4)
    requests = [call.request for call, _ in ANSWERS] + [
        calls.cfg_set(Settings(anchor=True)).request,
        calls.upd_rate_set(UpdateRate(1, 1)).request,
        calls.pos_set(LOCATION.position).request,
    ]
    now = 0.0
    module = Dwm1001(0xDECA0001, Flash(Settings(anchor=False)), random.Random(5), lambda: LOCATION, now)
    for _ in range(count):
        request = mutated(requests[generator.randrange(len(requests))], generator)
        with contextlib.suppress(FrameError):
            calls.call_of(request)
        now += generator.uniform(0.0, 0.1)
        module.receive(request, now)
        now += 0.05
        module.handle_timer(now)
        module.to_send(now)
