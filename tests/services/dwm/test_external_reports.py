"""Poses and ranges that another process gives in place of a UWB module."""

import struct
import sys
import threading
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from conftest import CONFIG, wait_until
from dwm_rig import ANCHORS
from hypothesis import given
from hypothesis import strategies as st

from services.dwm import external
from services.dwm.__main__ import BUS, source_of
from services.dwm.external import MAX_AGE_S, checked, location_of, pose_of
from swarm.bus.zenoh_bus import Bus
from swarm.config import parse
from swarm.config.example import EXAMPLE
from swarm.errors import ConfigError, PayloadError
from swarm.messages import ExternalReport, read
from swarm.messages.codec import decode, encode

MOCAP = Path(__file__).parents[3] / "examples" / "mocap"


def config_with(source: str):
    return parse(EXAMPLE.replace('source = "serial:/dev/serial0"', f'source = "{source}"'), Path("swarm.toml"))


def test_the_key_of_a_source_names_its_robot() -> None:
    config = config_with("bus:swarm/{robot}/mocap")
    assert source_of(config, "r1") == (BUS, "swarm/r1/mocap")


@pytest.mark.parametrize(
    "source", ["bus:", "bus:/swarm", "bus:swarm//x", "bus:swarm/*/pose", "bus:a b", "bus:{name}/x"]
)
def test_a_source_that_is_no_key_is_refused(source: str) -> None:
    with pytest.raises(ConfigError, match=r"bus:KEY"):
        config_with(source)


def test_a_pose_is_passed_on_with_its_time_and_deviation() -> None:
    pose = pose_of(checked(ExternalReport(x=1.0, y=2.0, heading=0.5, deviation=0.01, age=0.2)), 10.0, 7)
    assert (pose.t, pose.sequence, pose.x, pose.y, pose.heading) == (9.8, 7, 1.0, 2.0, 0.5)
    assert (pose.source, pose.quality, pose.deviation_x, pose.deviation_y) == ("external", 100, 0.01, 0.01)


def test_ranges_become_a_modules_answer() -> None:
    location = location_of(checked(ExternalReport(ranges={"C933": 1.5, "D001": 2.0})))
    assert [(each.anchor, each.distance) for each in location.ranges] == [("C933", 1.5), ("D001", 2.0)]
    assert location.position.quality == 0


@pytest.mark.parametrize(
    "report",
    [
        ExternalReport(),
        ExternalReport(x=1.0),
        ExternalReport(y=1.0),
        ExternalReport(x=1.0, y=1.0, ranges={"C933": 1.0}),
        ExternalReport(x=1.0, y=1.0, age=-1.0),
        ExternalReport(x=1.0, y=1.0, age=MAX_AGE_S + 1.0),
        ExternalReport(ranges={"C933": 0.0}),
        ExternalReport(ranges={"C933": 1e300}),
    ],
)
def test_a_report_that_says_nothing_or_nonsense_is_refused(report: ExternalReport) -> None:
    with pytest.raises(PayloadError):
        checked(report)


NUMBERS = st.none() | st.floats(-1e6, 1e6)
RANGES = st.dictionaries(st.text(max_size=8), st.floats(-10, 2000), max_size=4)


@given(st.builds(ExternalReport, NUMBERS, NUMBERS, NUMBERS, NUMBERS, RANGES, st.floats(-1, 20)))
def test_whatever_is_reported_gives_a_pose_ranges_or_a_refusal(report: ExternalReport) -> None:
    heard = decode(ExternalReport, encode(report), "a/key")
    try:
        checked(heard)
    except PayloadError:
        return
    assert (pose_of(heard, 1.0, 1).x == report.x) if heard.x is not None else location_of(heard).ranges


@pytest.fixture
def natnet(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(MOCAP))
    import from_natnet

    yield from_natnet
    for name in ("from_natnet", "from_csv"):
        sys.modules.pop(name, None)


def packet(bodies: list[tuple[float, ...]], *, sizes: bool) -> bytes:
    """A frame of mocap data with a marker set of two markers, one other marker and these rigid bodies."""
    set_bytes = b"all\0" + struct.pack("<i6f", 2, *range(6))
    others = struct.pack("<3f", 7.0, 8.0, 9.0)
    body_bytes = b"".join(struct.pack("<i7ffh", *body) for body in bodies)
    data = struct.pack("<i", 99)
    for count, section in ((1, set_bytes), (1, others), (len(bodies), body_bytes)):
        data += struct.pack("<i", count) + (struct.pack("<i", len(section)) if sizes else b"") + section
    return struct.pack("<HH", 7, len(data)) + data + b"\0" * 40


@pytest.mark.parametrize("sizes", [False, True])
def test_the_natnet_example_reads_tracked_bodies(natnet, sizes: bool) -> None:
    quarter = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
    bodies = [(1, 1.5, 2.5, 0.1, *quarter, 0.001, 1), (2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0)]
    ((name, x, y, heading),) = natnet.rigid_bodies(packet(bodies, sizes=sizes), sizes)
    assert (name, x, y) == (1, 1.5, 2.5)
    assert heading == pytest.approx(1.5707963, abs=1e-6)


@given(data=st.binary(max_size=200), cut=st.integers(0, 200), sizes=st.booleans())
def test_the_natnet_example_refuses_what_is_no_packet(data: bytes, cut: int, sizes: bool) -> None:
    sys.path.insert(0, str(MOCAP))
    try:
        from from_natnet import rigid_bodies
    finally:
        sys.path.remove(str(MOCAP))
    whole = packet([(1, 1.5, 2.5, 0.1, 0.0, 0.0, 0.0, 1.0, 0.0, 1)], sizes=sizes)
    for each in (struct.pack("<HH", 7, len(data)) + data, whole[:cut]):
        try:
            rigid_bodies(each, sizes)
        except ValueError:
            continue


def test_the_service_tells_reports_that_have_ended_from_those_that_never_came(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(external, "Localizer", MagicMock())
    monkeypatch.setattr(external, "SILENT_S", 0.0)
    monkeypatch.setattr(external, "_POLL", 0.01)
    service = MagicMock(stopping=threading.Event(), robot="r0")
    serving = threading.Thread(target=external.serve, args=(service, "a/key"))
    serving.start()
    try:
        wait_until(lambda: service.watchdog.call_count > 3)
        assert said_of(service) == {"nothing is reported on a/key yet"}
        (_, take), _ = service.bus.subscribe.call_args
        take("a/key", encode(ExternalReport(x=1.25, y=0.5)))
        wait_until(lambda: "nothing is reported on a/key any more" in said_of(service))
    finally:
        service.stopping.set()
        serving.join()


def said_of(service: MagicMock) -> set[str]:
    """Why a service has said that it is degraded."""
    return {call.args[0] for call in service.degraded.call_args_list}


def test_the_service_passes_on_what_is_reported_on_its_key(processes, router, runtime) -> None:
    processes.config.write_text(CONFIG + ANCHORS + '[dwm]\nsource = "bus:swarm/{robot}/mocap"\n')
    heard: dict[str, list[object]] = {"pose": [], "status": [], "ranges": []}
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
        bus.subscribe("swarm/r0/dwm/*", lambda key, data: heard[key.rsplit("/")[-1]].append(read(key, data)))
        processes.start_ready("-m", "services.dwm")
        wait_until(lambda: heard["status"] and heard["status"][-1].state == "degraded", what="that nothing is reported")
        assert "swarm/r0/mocap" in heard["status"][-1].reason

        def reported() -> bool:
            bus.publish("swarm/r0/mocap", b"nonsense")
            bus.publish("swarm/r0/mocap", ExternalReport(x=1.25, y=0.5))
            return bool(heard["pose"])

        wait_until(reported, what="a pose")
        wait_until(lambda: heard["status"][-1].state == "ready", what="a service that is well")
    assert (heard["pose"][0].x, heard["pose"][0].y, heard["pose"][0].source) == (1.25, 0.5, "external")
