"""Encoders: every count, at any speed the robot can reach and beyond, whatever goes on beside."""

import pytest

pytest_plugins = ("firmware_fixtures",)


def wrapped(counts):
    return tuple((count + 0x8000) % 0x10000 - 0x8000 for count in counts)


def settle(bench):
    bench.wheels(0, 0)
    bench.run(0.002)


def with_traffic(bench, seconds):
    end = bench.now + seconds
    while bench.now < end:
        bench.get("ENCODERS")
        bench.drive(100, -100)
        bench.put("LEDS", b"\1\0\1")
        if bench.sent():
            bench.feed(bytes.fromhex("400100410d") + bytes(12) + b"\x64" + b"\x49\x01\x00")


@pytest.mark.parametrize(("left", "right"), [(1000, 1000), (-1000, 1000), (10000, -9700)])
def test_encoders_lose_no_count_beside_traffic_on_the_bus(bench, left, right):
    """The robot's own maximum is about 6000 counts/s."""
    bench.wheels(left, right)
    with_traffic(bench, 0.15)
    settle(bench)
    assert bench.encoders() == bench.counts()
    assert abs(bench.counts()[0]) > 140
    assert bench.get("ENCODER_ERRORS") == b"\0\0"


def test_an_encoder_counts_up_when_its_wheel_turns_forward(bench):
    bench.wheels(500, -500)
    bench.run(0.1)
    left, right = bench.encoders()
    assert left > 40
    assert right < -40


@pytest.mark.slow
@pytest.mark.parametrize(("left", "right"), [(10000, 10000), (-10000, 9000), (6000, -10000)])
def test_exact_for_many_turns_and_across_the_wrap(bench, left, right):
    bench.wheels(left, right)
    with_traffic(bench, 5.0)
    settle(bench)
    assert abs(bench.counts()[0]) > 29000
    assert bench.encoders() == wrapped(bench.counts())
    assert bench.get("ENCODER_ERRORS") == b"\0\0"


def test_encoders_lose_no_count_when_wheels_turn_forward_and_back(bench):
    for speed in (8000, -8000, 300, -7000, 5000, -40, 9000):
        bench.wheels(speed, -speed)
        bench.run(0.013)
    settle(bench)
    assert bench.encoders() == bench.counts()
    assert bench.get("ENCODER_ERRORS") == b"\0\0"


def test_a_wheel_that_trembles_on_an_edge_counts_nothing(bench):
    bench.wheels(300, 300)
    bench.run(0.05)
    settle(bench)
    start = bench.counts()
    for _ in range(200):
        for speed in (9000, -9000):
            bench.wheels(speed, speed)
            bench.run(1.5e-4)
    settle(bench)
    assert bench.encoders() == bench.counts()
    assert all(abs(now - then) <= 2 for now, then in zip(bench.counts(), start, strict=True))


@pytest.mark.parametrize("side", [0, 1])
def test_a_missed_edge_is_told(bench, side):
    bench.run(0.001)
    bench.call("encoder_glitch", side)
    bench.run(0.001)
    errors = bench.get("ENCODER_ERRORS")
    assert errors[side] == 1
    assert errors[1 - side] == 0


def test_the_place_at_switch_on_is_zero_wherever_the_wheels_stand(new_bench):
    for _ in range(4):
        bench = new_bench()
        bench.run(0.0005)  # before the firmware looks
        for _ in range(3):
            bench.wheels(2000, -2000)
            bench.run(0.0007)
            bench.wheels(0, 0)
            bench.call("reset", 2)
            start = bench.counts()
            bench.run(0.02)
            assert bench.encoders() == (0, 0)
            bench.wheels(1000, 1000)
            bench.run(0.02)
            settle(bench)
            assert bench.encoders() == tuple(now - then for now, then in zip(bench.counts(), start, strict=True))
            assert bench.get("ENCODER_ERRORS") == b"\0\0"


@pytest.mark.parametrize(("left", "right"), [(0, 175e3), (30e3, 156e3), (173e3, 20e3), (0, 400e3), (1e6, -1e6)])
def test_an_encoder_that_floats_keeps_nobody_from_stopping_the_motors_nor_from_the_bus(bench, left, right):
    """Its interrupts go before all others: the clock of the motors' watchdog needs what they leave."""
    bench.wheels(left, right)
    bench.run(0.02)
    bench.i2c_stats()
    for _ in range(20):
        bench.drive(200, 200)
        bench.get("BATTERY")
    assert bench.i2c_stats().refused == 0
    start = bench.now
    stopped = bench.run_until(lambda: bench.motors() == (0.0, 0.0), 0.21)
    assert 0.1995 <= stopped - start <= 0.202
    bench.wheels(1000, 1000)  # the first edge brings what the last one of the storm left over
    bench.run(0.01)
    settle(bench)
    assert bench.call("resets") == 0
    before, true = bench.encoders(), bench.counts()
    bench.wheels(3000, -3000)
    bench.run(0.1)
    settle(bench)
    assert wrapped(now - then for now, then in zip(bench.encoders(), before, strict=True)) == wrapped(
        now - then for now, then in zip(bench.counts(), true, strict=True)
    )
