"""`swarm measure i2c`: the meter, both ways to it, and what is printed."""

import argparse
import json
from pathlib import Path

import pytest
from device_rig import Bench
from slack_rig import AT_100_KHZ, Ticking

from services.balancer import measure_i2c as i2c
from services.balancer.core.devices.rates import FAILURES, RateMeter, check_measurement, longest
from services.balancer.i2c import RETRY_S, BusInUseError
from sim.devices.i2c import SimulatedBus
from swarm.errors import LocalError
from swarm.messages import I2CRates, MeasureI2C, ModuleRequest


@pytest.mark.parametrize("size", [1, 8, 28])
def test_rates_in_the_simulation_are_those_of_the_wire(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(i2c.clock, "now", lambda: bench.now)

    def sleep(seconds: float) -> None:
        bench.now += seconds

    bench.balboa._sleep = sleep
    found = i2c.measure(bench.bus, bench.balboa, MeasureI2C("t", size, 10))
    assert (found.count, found.failed, found.problem, found.ticket) == (10, 0, "", "t")
    # 100 kHz, 9 bits a byte, START and STOP; the ATmega's hold of 25 us with each byte; pauses of 150 us.
    read_s = (4 + 9 * (3 + size)) * 10e-6 + (3 + size) * 25e-6 + 2 * 150e-6
    write_s = (2 + 9 * (2 + size)) * 10e-6 + (2 + size) * 25e-6 + 150e-6
    assert found.read == pytest.approx(8 * size / read_s, rel=1e-3)
    assert found.write == pytest.approx(8 * size / write_s, rel=1e-3)


def test_failed_transfers_are_counted_and_not_in_the_rates() -> None:
    bench = Bench()
    bench.robot.failures = [121, 0, 0, 110, 0, 5]
    found = i2c.measure(bench.bus, bench.balboa, MeasureI2C("t", 4, 3))
    assert (found.count, found.failed, found.problem) == (3, 3, "")


def test_a_dead_bus_is_given_up() -> None:
    bench = Bench()
    bench.robot.failures = [121] * 100
    found = i2c.measure(bench.bus, bench.balboa, MeasureI2C("t", 4, 3))
    assert (found.read, found.write, found.failed) == (None, None, FAILURES)
    assert found.problem == "I2C: Remote I/O error"


def test_a_balancer_measures_in_its_slack() -> None:
    ticking = Ticking().run(4.0)
    ticking.tasks.obey(MeasureI2C("mine", 28, 20), ticking.rig.now)
    ticking.run(3.0)
    (found,) = ticking.of(I2CRates)
    assert (found.ticket, found.size, found.count, found.problem) == ("mine", 28, 20, "")
    spent: dict[int, float] = {}
    for tick, transfer in ticking.transfers:
        spent[tick] = spent.get(tick, 0.0) + AT_100_KHZ.duration(transfer)
    assert max(spent.values()) < 4.5e-3
    assert ticking.rig.balancer.mode == "balancing"


def test_a_request_to_the_module_goes_first() -> None:
    """Both use the mailbox's window."""
    ticking = Ticking().run(4.0)
    ticking.tasks.obey(MeasureI2C("mine", 28, 50), ticking.rig.now)
    ticking.run(0.2)
    request = b"\x99\xfd" + bytes(range(253))
    ticking.tasks.obey(ModuleRequest("long", request), ticking.rig.now)
    sent = b""
    while not sent.startswith(b"\x99"):
        ticking.run(0.01)
        sent = ticking.robot.atmega.line.to_send() or sent
    assert sent == request
    ticking.run(10.0)
    assert [each.count for each in ticking.of(I2CRates)] == [50]


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (MeasureI2C("t", 0, 10), "size: 0 bytes, expected 1 to 28"),
        (MeasureI2C("t", 29, 10), "size: 29"),
        (MeasureI2C("t", 8, 0), "count: 0, expected 1 to 1000"),
        (MeasureI2C("t" * 65, 8, 1), "ticket"),
    ],
)
def test_what_cannot_be_measured_is_refused(request_: MeasureI2C, reason: str) -> None:
    with pytest.raises(LocalError, match=reason):
        check_measurement(request_)


def arguments(*text: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    i2c.add_arguments(parser)
    return parser.parse_args(text)


def answer(request: MeasureI2C) -> I2CRates:
    return I2CRates(1.0, request.ticket, request.size, request.count, 1, 21_234.0, None, "")


def test_the_table_has_the_thesis_beside_it() -> None:
    assert i2c.table("r0", i2c._measured(arguments("--sizes", "8,8,1", "--count", "7"), "r0", answer)) == [
        "r0: I2C with the ATmega, kbit/s of data",
        " bytes  transfers  failed     read    write",
        "     8          7       1     21.2        -",
        "     1          7       1     21.2        -",
        "thesis, 8 bytes, 100 kHz        21       53",
    ]


@pytest.mark.parametrize("words", [(), ("r0", "r2"), ("--robots", "r0,r2")])
def test_several_robots_are_measured_one_after_the_other(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def find(args: argparse.Namespace) -> dict[str, Path]:
        assert args.robots == (["r0", "r2"] if words else [])
        return {"r0": tmp_path, "r2": tmp_path}

    monkeypatch.setattr(i2c.buses, "directories_of", find)
    monkeypatch.setattr(i2c, "_answers", lambda *_: True)
    monkeypatch.setattr(i2c.Bus, "wait_connected", lambda *_: True)
    monkeypatch.setattr(i2c, "_through", lambda *_: answer)
    assert i2c.run(arguments(*words, "--sizes", "8", "--json")) == 0
    found = json.loads(capsys.readouterr().out)
    assert [found[name][0]["read"] for name in ("r0", "r2")] == [21_234.0, 21_234.0]


def test_a_measurement_that_the_bus_has_little_time_for_ends_with_what_there_was_time_for() -> None:
    meter = RateMeter()
    meter.measure(MeasureI2C("t", 28, 20))
    now = 100.0
    while meter.next(now) is not None:  # a transfer each second
        meter.timed(4e-3)
        meter.take(b"", now)
        now += 1.0
    assert longest(20) < now - 100.0 < longest(20) + 2.0
    assert meter.news is not None
    assert (meter.news.ticket, meter.news.count, meter.news.problem) == ("t", 1, "")
    assert not meter.active


def test_a_problem_is_an_error() -> None:
    with pytest.raises(LocalError, match="r0: I2C: dead"):
        i2c._measured(arguments(), "r0", lambda request: I2CRates(1.0, "", 1, 0, 9, None, None, "I2C: dead"))


@pytest.mark.parametrize("bad", [("--sizes", "29"), ("--sizes", "x"), ("--count", "0"), ("--count", "1001")])
def test_measure_i2c_refuses_arguments_out_of_range(bad: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        arguments(*bad)
    assert "expected" in capsys.readouterr().err


class Real(Bench):
    """In place of the kernel's bus."""

    def __init__(self) -> None:
        super().__init__()
        self.closed = False
        self.balancer_after = 1000
        """Openings after which a balancer has the bus."""

    def open(self) -> SimulatedBus:
        if self.balancer_after == 0:
            raise BusInUseError("/dev/i2c-1 is in use")
        self.balancer_after -= 1
        self.closed = False
        self.bus.close = self.close
        return self.bus

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Real:
    """A robot whose balancer does not answer over the bus of its services."""
    made = Real()
    monkeypatch.setattr(i2c, "KernelBus", made.open)
    monkeypatch.setattr(i2c.buses, "directories_of", lambda _: {"r4": i2c.DEFAULT_RUNTIME})
    monkeypatch.setattr(i2c, "_answers", lambda *_: False)
    monkeypatch.setattr(i2c, "PATIENCE", 0.0)
    return made


def test_without_a_balancer_the_bus_is_taken_directly(real: Real, capsys: pytest.CaptureFixture[str]) -> None:
    assert i2c.run(arguments("--sizes", "4", "--count", "3")) == 0
    assert capsys.readouterr().out.startswith("r4: I2C with the ATmega")
    assert real.closed
    assert real.robot.atmega.motors == (0.0, 0.0)
    del real.robot.devices[20]
    with pytest.raises(LocalError, match="the ATmega does not answer"):
        i2c.run(arguments())


def test_a_bus_that_a_balancer_has_is_left_alone_while_the_router_is_away(real: Real) -> None:
    real.balancer_after = 0
    with pytest.raises(LocalError, match=r"balancer of r4 does not answer, and .* in use.*swarm services restart bus"):
        i2c.run(arguments())
    assert real.robot.bits == 0


def test_a_balancer_that_is_started_has_the_bus_after_the_size_under_way(
    real: Real, monkeypatch: pytest.MonkeyPatch
) -> None:
    real.balancer_after = 1
    pauses: list[float] = []
    monkeypatch.setattr(i2c.time, "sleep", lambda seconds: pauses.append(seconds) if real.closed else None)
    with pytest.raises(LocalError, match="in use"):
        i2c.run(arguments("--sizes", "4,8"))
    assert sum(pauses) > RETRY_S, "the balancer has looked meanwhile"


def test_a_balancer_of_a_simulation_that_is_silent_is_no_reason_to_touch_a_bus(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(i2c.buses, "directories_of", lambda _: {"r0": tmp_path})
    monkeypatch.setattr(i2c, "PATIENCE", 0.0)
    with pytest.raises(LocalError, match="the balancer of r0 does not answer"):
        i2c.run(arguments("r0"))
