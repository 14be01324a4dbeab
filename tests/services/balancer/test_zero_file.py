"""The gyro's zero that a balancer leaves to the next one: taken within limits, and whatever lies there is survived."""

import logging
from pathlib import Path

import pytest
from balancer_rig import Rig
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control.estimation.gyro import Zero
from services.balancer.zero_file import LARGEST, MEASURED_S, USED_S, ZeroFile
from swarm.process.paths import GYRO_ZERO

ZERO = Zero(0.011, -0.02, 0.003)


def left(tmp_path: Path, *, measured: float = 100.0, used: float = 100.0, zero: Zero = ZERO) -> ZeroFile:
    """What the next process finds."""
    before = ZeroFile(tmp_path)
    before.keep(zero, measured)
    before.keep(zero, used)
    return ZeroFile(tmp_path)


def test_a_zero_in_use_is_taken_to_the_bit(tmp_path: Path) -> None:
    assert left(tmp_path).read(100.0 + USED_S) == ZERO
    assert [path.name for path in tmp_path.iterdir()] == [GYRO_ZERO]


def test_one_that_nobody_used_for_a_while_is_not(tmp_path: Path) -> None:
    assert left(tmp_path).read(100.1 + USED_S) is None


def test_one_that_was_measured_long_ago_is_not(tmp_path: Path) -> None:
    end = 100.0 + MEASURED_S
    assert left(tmp_path, used=end).read(end) == ZERO
    assert left(tmp_path, used=end + 1.0).read(end + 1.0) is None


def test_a_restart_does_not_make_it_younger(tmp_path: Path) -> None:
    second = left(tmp_path)
    assert second.read(105.0) == ZERO
    second.keep(ZERO, 100.0 + MEASURED_S)
    assert ZeroFile(tmp_path).read(101.0 + MEASURED_S) is None


def test_one_of_another_boot_is_not(tmp_path: Path) -> None:
    """The clock begins anew: what lies there is of the future."""
    assert left(tmp_path, measured=5000.0, used=5000.0).read(20.0) is None


@pytest.mark.parametrize("zero", [Zero(LARGEST * 1.01), Zero(float("nan")), Zero(0.0, float("inf"))])
def test_one_that_no_gyro_has_is_not(tmp_path: Path, zero: Zero) -> None:
    assert left(tmp_path, zero=zero).read(101.0) is None


@given(
    st.one_of(st.binary(max_size=80), st.lists(st.floats(), max_size=7).map(lambda n: " ".join(map(repr, n)).encode()))
)
def test_whatever_lies_there_is_survived(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    folder = tmp_path_factory.mktemp("runtime")
    (folder / GYRO_ZERO).write_bytes(data)
    found = ZeroFile(folder).read(100.0)
    assert found is None or all(abs(axis) <= LARGEST for axis in found)


def test_where_it_cannot_be_kept_it_is_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "balancer.zero.new").mkdir()
    file = ZeroFile(tmp_path)
    with caplog.at_level(logging.WARNING):
        file.keep(ZERO, 1.0)
        file.keep(ZERO, 2.0)
    assert len(caplog.records) == 1
    assert file.read(2.0) is None


def test_a_restarted_balancer_stands_within_a_second(tmp_path: Path) -> None:
    """Of a robot that stands, with errors of its sensors: the first one looks for 2 s, the next one for 0.2."""
    first = Rig(seed=5)
    first.run(4.0)
    assert first.balancer.mode == "balancing"
    zero = first.balancer.gyro_zero
    assert zero is not None
    second = Rig(seed=5, kept_zero=zero)
    second.run(0.3)
    assert second.balancer.ready
    second.run(6.0)
    assert second.balancer.mode == "balancing"
    assert second.balancer.gyro_zero == zero
