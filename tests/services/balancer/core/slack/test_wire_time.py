"""What transfers take on a bus is learned from those of the control step, and slack tasks are planned by it."""

import random
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.devices import balboa
from services.balancer.core.devices.display import SLICE
from services.balancer.core.slack.queue import STARVED_S, QueuedTask, by_urgency
from services.balancer.core.slack.transfers import read, write
from services.balancer.core.slack.wire_time import SLOWEST_HZ, Transfer, WireTime

SELECT_BITS, IMU_BITS = 2 + 9 * 2, 2 * 2 + 9 * 15


class Bus:
    """The three transfers of a control step as they last on a bus."""

    def __init__(self, scl: float, hold: float, call: float) -> None:
        self.scl, self.hold, self.call = scl, hold, call

    def teach(self, wire: WireTime, ticks: int, count: int = 6, late: float = 0.0) -> None:
        for _ in range(ticks):
            wire.learn(
                SELECT_BITS / self.scl + 2 * self.hold + self.call + late,
                IMU_BITS / self.scl + self.call + late,
                count,
                (2 + 9 * (1 + count)) / self.scl + (1 + count) * self.hold + self.call + late,
            )


@given(st.floats(40e3, 400e3), st.floats(8e-6, 40e-6), st.floats(0.0, 0.3e-3), st.integers(6, 22))
def test_clock_hold_and_overhead_are_told_apart(scl: float, hold: float, call: float, count: int) -> None:
    wire = WireTime()
    Bus(scl, hold, call).teach(wire, 600, count)
    assert 1.0 / wire.bit_s == pytest.approx(scl, rel=0.03)
    assert wire.scl == pytest.approx(scl, rel=0.03)
    assert wire.byte_s == pytest.approx(9 / scl + hold, rel=0.05)
    assert wire.duration(read(balboa.UWB, 32)) == pytest.approx(
        (4 + 9 * 35) / scl + 35 * hold + 2 * (call + balboa.PAUSE_S), rel=0.05
    )


@pytest.mark.parametrize("seed", range(5))
def test_one_tick_in_ten_that_another_process_made_longer_changes_little(seed: int) -> None:
    chance, wire, bus = random.Random(seed), WireTime(), Bus(100e3, 25e-6, 0.1e-3)
    for _ in range(1000):
        bus.teach(wire, 1, late=chance.choice((1e-3, 50e-3)) if chance.random() < 0.1 else 0.0)
    assert 80e3 < 1.0 / wire.bit_s < 125e3
    assert wire.scl == pytest.approx(100e3, rel=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_scl_is_told_truly_where_other_processes_make_half_of_the_transfers_longer(seed: int) -> None:
    chance, wire, bus = random.Random(seed), WireTime(), Bus(100e3, 25e-6, 0.1e-3)
    for tick in range(1000):
        bus.teach(wire, 1, late=chance.uniform(0.0, 2e-3) if chance.random() < 0.5 else 0.0)
        assert tick < 300 or wire.scl == pytest.approx(100e3, rel=0.1)


def test_a_clock_that_drops_is_followed_within_ten_ticks() -> None:
    wire = WireTime()
    Bus(100e3, 25e-6, 0.1e-3).teach(wire, 300)
    Bus(62.5e3, 25e-6, 0.1e-3).teach(wire, 10)
    assert 1.0 / wire.bit_s < 66e3
    Bus(62.5e3, 25e-6, 0.1e-3).teach(wire, 100)
    assert wire.scl < 66e3


def test_before_anything_was_measured_the_slowest_clock_is_expected() -> None:
    assert 1.0 / WireTime().bit_s == pytest.approx(SLOWEST_HZ)


@given(st.floats(40e3, 400e3), st.floats(0.0, 5e-3))
def test_what_there_is_room_for_fits_and_one_byte_more_does_not(scl: float, seconds: float) -> None:
    wire = WireTime(scl)
    room = wire.room(seconds)
    kinds = (
        (room.read, 32, lambda count: read(balboa.UWB, count)),
        (room.write, 31, lambda count: write(balboa.NOTES, bytes(count))),
        (room.send, 32, lambda count: Transfer(0x3C, bytes(count))),
    )
    for count, most, transfer in kinds:
        assert count <= most
        if count > 0:
            assert wire.duration(transfer(count)) <= seconds + 1e-9
        if 0 <= count < most:
            assert wire.duration(transfer(count + 1)) > seconds - 1e-9


def test_the_page_of_the_bus_has_the_durations_of_the_slack_tasks() -> None:
    wire = WireTime(100e3)
    display = wire.duration(Transfer(0x3C, bytes(1 + SLICE))) + wire.duration(Transfer(0x3C, bytes(4)))
    durations = {
        "LEDs": [wire.duration(write(balboa.LEDS, bytes(3)))],
        "notes": [wire.duration(write(balboa.NOTES, bytes(1 + 2 * balboa.TUNE_NOTES)))],
        "UWB reports": [wire.duration(read(balboa.UWB, count)) for count in (18, 28, balboa.UWB_PLACE_SIZE)],
        "UWB: state": [wire.duration(read(balboa.UWB_STATE, balboa.PROGRESS_SIZE))],
        "requests": [wire.duration(Transfer(balboa.ADDRESS, bytes(2), 1 + balboa.WINDOW_SIZE))],
        "battery": [wire.duration(read(balboa.BUTTONS, balboa.HOUSEKEEPING_SIZE))],
        "display": [display],
    }
    page = (Path(__file__).parents[5] / "docs/reference/robot/i2c-bus.md").read_text()
    for task, seconds in durations.items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| {task}") and line.count("|") == 6]
        told = [float(number) for number in re.findall(r"\d+\.\d", row.split("|")[4])]
        assert told == pytest.approx([1e3 * each for each in seconds], abs=0.06), task


class Nothing:
    """A task whose transfers do not matter here."""

    def next(self, now: float, room: object) -> None: ...
    def take(self, data: bytes, now: float) -> None: ...
    def fail(self, error: OSError, now: float) -> None: ...


def queue(**patience: float) -> list[QueuedTask]:
    return [QueuedTask(name, Nothing(), seconds) for name, seconds in patience.items()]


def test_tasks_keep_their_order_until_one_loses_its_patience() -> None:
    tasks = queue(uwb=0.05, display=0.3)
    for each in tasks:
        each.wants(0.0)
    assert [each.name for each in by_urgency(tasks, 0.04)] == ["uwb", "display"]
    tasks[0].served(0.28)
    assert [each.name for each in by_urgency(tasks, 0.31)] == ["display", "uwb"]


@pytest.mark.parametrize("every", [1, 2, 3])
def test_no_task_starves_where_there_is_room_for_one_transfer_in_three_ticks(every: int) -> None:
    tasks = queue(notes=0.05, uwb=0.05, module=0.1, battery=0.5, display=0.3, measure=1.0)
    longest = dict.fromkeys(tasks, 0.0)
    for tick in range(1000):
        now = tick * 0.01
        for each in tasks:
            each.wants(now)
            longest[each] = max(longest[each], each.waited(now))
        if tick % every == 0:
            by_urgency(tasks, now)[0].served(now)
    assert max(longest.values()) < STARVED_S
