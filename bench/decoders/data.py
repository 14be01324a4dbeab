"""The decoders of messages, devices and files, for the fuzzer."""

import contextlib
import dataclasses
import json
import os
import random
import tempfile
import types
import typing
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import msgpack

from bench.decoders.run import MIB, Target
from laptop.fleet.core import collect
from laptop.fleet.files import journal
from laptop.fleet.release import versions
from laptop.view.feeds.picture import Picture, track
from services.balancer.bridge import link
from services.balancer.core.devices import balboa, imu, uwb
from services.balancer.core.flashing import intel_hex
from services.dwm.core.calibration import calibration_file
from services.dwm.core.module import calls, tlv
from services.dwm.core.module.exchange import ModuleExchange
from services.dwm.core.module.tlv import LOC_GET, AnchorRange, Location, Position
from services.mesh import link_address
from swarm import messages
from swarm.bluetooth import hci
from swarm.config import keyfile
from swarm.config.load import parse as parse_config
from swarm.errors import ConfigError, FrameError, LocalError, PayloadError, RecordingError, RemoteError
from swarm.messages import codec
from swarm.messages.json_values import json_value
from swarm.onboard import lookout
from swarm.recording import thesis_csv
from swarm.recording.core import json_text, mcap, writer
from swarm.recording.reader import RecordingReader
from swarm.recording.survey import survey
from swarm.recording.thesis_ranges import read_recording

Made = tuple[Sequence[bytes], Callable[[bytes], object]]
Prepare = Callable[[random.Random], Made]


def simple(golden: Sequence[bytes], *decoders: Callable[[bytes], object]) -> Prepare:
    """Decoders without a state; each input goes to one of them."""

    def prepare(rng: random.Random) -> Made:
        def feed(data: bytes) -> object:
            return decoders[int(rng.random() * len(decoders))](data)

        return golden, feed

    return prepare


def text(decoder: Callable[[str], object]) -> Callable[[bytes], object]:
    """A decoder of text, for bytes."""
    return lambda data: decoder(data.decode("utf-8", "replace"))


# -- messages


def sample(kind: Any) -> Any:
    """A value of a message's type, or of the type of one of its fields."""
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return {each.name: sample(hints[each.name]) for each in dataclasses.fields(kind)}
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return sample(arguments[0])
    if origin is tuple:
        return [sample(arguments[0])] * 2
    if origin is dict:
        return {"name": sample(arguments[1])}
    return {float: 1.5, int: 3, bool: True, str: "r0", bytes: b"payload"}.get(kind)


def _messages(rng: random.Random) -> Made:
    """Every message type; the first byte of an input says which."""
    kinds = sorted(set(messages.topics().values()), key=lambda kind: kind.__name__)
    golden = [bytes((place,)) + msgpack.packb(sample(kind)) for place, kind in enumerate(kinds)]
    return golden, lambda data: codec.decode(kinds[data[0] % len(kinds)], data[1:], "key") if data else None


# -- devices

_PLACE = Position(6.97, 5.17, -1.77, 53)
_RANGES = (AnchorRange("022E", 3.38, 100, Position(7.94, 8.03, 0.0, 100)),) * 2
_ANSWER = tlv.encode_location(Location(_PLACE, _RANGES))


def _tlv(rng: random.Random) -> Made:
    """Answers of the UWB module."""
    known = (LOC_GET, calls.POS_GET, calls.CFG_GET, calls.UPD_RATE_GET, calls.VER_GET, calls.NODE_ID_GET)

    def feed(data: bytes) -> None:
        exchange = ModuleExchange(known[int(rng.random() * len(known))])
        exchange.receive(data)
        exchange.expire()

    okay = tlv.encode_refusal(tlv.OK)
    others = (tlv.encode_part(calls.CONFIG, b"\x5a\x04"), tlv.encode_part(calls.NODE_ID, bytes(range(8))))
    return [_ANSWER, *(okay + other for other in others)], feed


def _block(data: bytes) -> None:
    padded = data[: balboa.UWB_SIZE].ljust(balboa.UWB_SIZE, b"\0")
    uwb.check(data)
    uwb.decode(padded, 1.0, 0, 1, 0)


_REGISTERS = [bytes(range(size)) for size in (4, 12, balboa.MOTION_SIZE, balboa.HOUSEKEEPING_SIZE, balboa.UWB_SIZE)]
_DATAGRAMS = [link._BYTES[kind] + msgpack.packb(sample(kind)) for kind in link._BYTES if dataclasses.is_dataclass(kind)]
_HCI = [bytes((4, 0x0E, 7, 1, 5, 0x14, 0, 11, 0, 0xC8)), bytes((4, 0x0F, 4, 1, 1, 5, 0x14))]
_HEX = b":100000000C945C000C946E000C946E000C946E00CA\n:00000001FF\n"


# -- files

_CHUNK_INDEX = 93
"""Bytes of the index of a chunk with two topics."""


def recording() -> bytes:
    """Return a whole recording: chunks, two checkpoints of which the first names the second, the summary, the end."""
    made = writer.Writer("test", epoch_ns=0)
    made.metadata("run", {"app": "x", "epoch_ns": "5", "clock": "c"})
    data = bytearray()
    with mock.patch.object(writer, "INDEX_SIZE", 2 * _CHUNK_INDEX):
        for i in range(10):
            made.write("ab"[i % 2], 0.1 * i, {"i": i})
            if i % 2:
                made.cut()
                data += made.take()
    for at, after in pairwise(made.checkpoints):
        place, offset = mcap.link(at, after)
        data[place : place + len(offset)] = offset
    return bytes(data) + b"".join(made.finish(lambda at, length: bytes(data[at : at + length])))


def _recordings(rng: random.Random) -> Made:
    """Recordings, read as a person does and as a process does that goes on with them."""
    file = os.memfd_create("recording")
    path = Path(f"/proc/self/fd/{file}")

    def feed(data: bytes) -> None:
        os.ftruncate(file, 0)
        os.pwrite(file, data, 0)
        if rng.random() < 0.01:
            os.ftruncate(file, 256 * MIB)  # zeros: what a record claims is there
        if rng.random() < 0.5:
            survey(file)
            return
        for each in RecordingReader(path).samples():
            assert each.message is not None

    return [recording()], feed


def _csv(rng: random.Random) -> Made:
    """Recordings of the thesis in CSV, as a source of measurements and as what is imported."""
    # In memory: it is rewritten for each input. It goes with `feed`.
    kept = tempfile.TemporaryDirectory(prefix="decoders", dir="/dev/shm")

    def feed(data: bytes) -> None:
        if rng.random() < 0.5:
            (Path(kept.name) / "0.csv").write_bytes(data)
            read_recording(Path(kept.name), 0)
        else:
            for _ in thesis_csv.read(
                data.decode("ascii", "replace"), ("consensus", "localization")[len(data) % 2], "x"
            ):
                pass

    row = "1600000000.5,10.0,20.0,0.0,0.0,0.0,0.0"
    return [
        f"{row}\n{row},0,96040000.0,100.0,20.0,30.0\n{row},1,96040000.0,100.0,20.0,30.0\n".encode(),
        b"1.0,2.0\n2.0,3.0,0\n",
    ], feed


_CALIBRATION = b"""robot = "r0"
layout = "0123456789abcdef"
anchors = ["D001 (0, 0, 0)"]
[distance]
gain = 1.0
offset = 0.1
model = "linear"
made = 2024-01-01T00:00:00
places = 3
samples = 300
sha256 = "00"
nested = 0.1
residuals = [[1.0, 0.1]]
left_out = { linear = 0.1 }
"""
_CONFIG = b"""network = "lab"
[[robots]]
name = "r0"
link = "tcp:10.0.0.1:4000"
[[robots]]
name = "r1"
bluetooth = "B8:27:EB:12:34:56"
[topology]
shape = "line"
[mesh]
key = "/etc/swarm/key"
heartbeat = 0.5
[[relay]]
keys = "swarm/{self}/dwm/pose"
max_rate = 5.0
[[anchors]]
address = "D001"
x = 0.0
y = 1.0
"""
_KEYS = b"# comment\n68a1f0c2 9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08\n"
_LIST = b"1234 consensus-1/r0.mcap\0005 consensus-1/run.toml\0"
_ENTRY = b'{"__CURSOR":"s=1","__REALTIME_TIMESTAMP":"1700000000123456","MESSAGE":"x","PRIORITY":"4","_PID":"12"}'


def _stream(rng: random.Random) -> Made:
    """A robot's answer to what was asked for."""
    files = [collect.File("consensus-1/r0.mcap", 20), collect.File("consensus-1/run.toml", 0)]

    def feed(data: bytes) -> None:
        stream = collect.Stream(collect.plan(files, {}))
        middle = int(rng.random() * (len(data) + 1))
        for part in (data[:middle], data[middle:]):
            for _ in stream.receive(part):
                pass

    done = b"0" * 64 + b"  -\n"
    return [b"+\n" + b"x" * 20 + done + b"+\n" + done, b"-\n-\n"], feed


# -- the live page

_TOPICS = sorted(
    {f"{service}/{topic}".replace("*", "x") for service, topic in messages.topics()} | {"view/reach", "app/x/own"}
)


def _pages(rng: random.Random) -> Made:
    """What robots say to the live page, in messages and as JSON of a recording; now and then a page looks. The first
    byte of an input says the key."""
    picture = Picture()
    now = 0.0

    def look(robot: str, topic: str) -> None:
        telling = [
            picture.values(robot, picture.since(robot, 0, 0)),
            picture.values(robot, picture.look(robot, now)),
            picture.hops(),
            picture.services(),
            picture.events_since(0),
        ]
        rows, way = list(picture.history(robot, topic)), list(picture.trail(robot, 60.0, now))
        json.dumps([telling, rows, way, picture.newest(robot, topic)], allow_nan=False)

    def feed(data: bytes) -> None:
        nonlocal now
        now += 0.1 * rng.random() - 0.01
        robot, topic, said = (
            ("r0", "r1")[int(rng.random() * 2)],
            _TOPICS[data[0] % len(_TOPICS) if data else 0],
            data[1:],
        )
        way = rng.random()
        if way < 0.7:
            picture.take(("", robot)[int(rng.random() * 2)], f"swarm/{robot}/{topic}", said, now)
        elif way < 0.9:
            with contextlib.suppress(ValueError, RecursionError):
                value = json_value(json_text.decode(said))
                picture.put(robot, topic, value, now)
                json.dumps(list(track([(now, value)], 0.0)))
        else:
            name = said.decode("utf-8", "replace")
            picture.take(robot, f"swarm/{robot}/{name}", said, now)
            picture.alive(robot, name, rng.random() < 0.5, now)
            picture.passed(name, robot, len(said))
        if rng.random() < 0.01:
            look(robot, topic)

    kinds = messages.topics()
    values = {f"{service}/{topic}".replace("*", "x"): sample(kind) for (service, topic), kind in kinds.items()}
    golden = [bytes((place,)) + msgpack.packb(values.get(topic)) for place, topic in enumerate(_TOPICS)]
    told = [
        bytes((place,)) + json_text.encode(values.get(topic) or {"x": 1.5, "y": 10**30, "by": None})
        for place, topic in enumerate(_TOPICS)
    ]
    return [*golden, *told], feed


def _lookout(rng: random.Random) -> Made:
    """What a lookout tells and is told, in parts as a network makes them."""

    def feed(data: bytes) -> None:
        ends = sorted(int(rng.random() * (len(data) + 1)) for _ in range(3))
        parts = [data[begin:end] for begin, end in pairwise([0, *ends, len(data)])]
        for _ in lookout.unpacked(parts, lookout.MAX_COMMAND):
            pass

    told = (["bus", True], ["key", "swarm/r0/x/y", bytes(9)], ["clock", 1.5], ["swarm/r0/mesh/set/arm", b"x", 2.5])
    return [msgpack.packb(each) for each in told] + [b"\xdd\x00\x01\x00\x00" * 200, b"\x90" * 9000], feed


def _as_config(data: bytes) -> object:
    return parse_config(data.decode("utf-8", "replace"), Path("swarm.toml"))


TARGETS = (
    Target("messages of the bus", ("swarm/messages/codec.py",), _messages, (PayloadError,)),
    Target("UWB module: answers", ("services/dwm/core/module/tlv.py", "services/dwm/core/module/calls.py"), _tlv),
    Target("UWB module: requests", ("services/dwm/core/module/calls.py",),
           simple([b"\x0c\x00", b"\x02\x00"], calls.call_of),
           (FrameError,)),
    Target("ATmega: UWB block", ("services/balancer/core/devices/uwb.py", "services/balancer/core/devices/balboa.py"),
           simple(_REGISTERS, _block), (RemoteError,)),
    Target("ATmega and IMU: registers",
           ("services/balancer/core/devices/balboa.py", "services/balancer/core/devices/imu.py"),
           simple(_REGISTERS, balboa.decode_motion, balboa.decode_housekeeping, balboa.decode_progress, imu.decode),
           (RemoteError,)),
    Target("balancer: datagrams of the loop", ("swarm/messages/codec.py",), simple(_DATAGRAMS, link.unpack),
           (PayloadError,)),
    Target("Bluetooth: HCI events", ("swarm/bluetooth/hci.py",),
           simple(_HCI, hci.reading, hci.written_supervision, lambda packet: hci.switched_role(packet, bytes(6))),
           (FrameError,)),
    Target("Intel HEX", ("services/balancer/core/flashing/intel_hex.py",),
           simple([_HEX], text(lambda each: intel_hex.parse(each, 28 * 1024))), (LocalError,)),
    Target("recordings (MCAP)",
           ("swarm/recording/core/mcap.py", "swarm/recording/reader.py", "swarm/recording/survey.py",
            "swarm/recording/core/json_text.py"),
           _recordings, (RecordingError,), room=8),
    Target("recorded messages (JSON)", ("swarm/recording/core/json_text.py",),
           simple([json_text.encode({"t": 1.5, "a": [1, {"b": None}]})], json_text.decode),
           (ValueError, RecursionError)),
    Target("recordings of the thesis (CSV)", (), _csv, (RecordingError,)),
    Target("live page: what robots say", ("laptop/view/feeds/picture.py", "swarm/recording/core/json_text.py"), _pages,
           room=48),
    Target("lookout", ("swarm/onboard/lookout.py",), _lookout, (PayloadError,)),
    Target("swarm.toml", ("swarm/config/load.py",), simple([_CONFIG], _as_config), (ConfigError,), room=8),
    Target("calibration file", ("services/dwm/core/calibration/calibration_file.py",),
           simple([_CALIBRATION], text(lambda each: calibration_file.parse(each, "x"))), (ConfigError,)),
    Target("key file", ("swarm/config/keyfile.py",),
           simple([_KEYS], lambda data: keyfile.parse_keys(data, Path("key"))), (LocalError,)),
    Target("addresses of robots", (), simple([b"tcp:10.0.0.1:4000", b"rfcomm:B8:27:EB:12:34:56"],
                                             text(link_address.parse)), (ConfigError,)),
    Target("fetch: list of files", (), simple([_LIST], text(collect.parse_list)), (RemoteError,)),
    Target("fetch: stream of files", (), _stream, (RemoteError,)),
    Target("fetch: journal", ("laptop/fleet/files/journal.py",),
           simple([_ENTRY, b"123 s=1;i=2\n"], text(journal.entry), text(journal.JournalMark.of))),
    Target("fleet: versions of robots", ("laptop/fleet/release/versions.py",),
           simple([b'{"value": {"revision": 3, "layout": 2}}'], text(versions.firmware))),
)  # fmt: skip
