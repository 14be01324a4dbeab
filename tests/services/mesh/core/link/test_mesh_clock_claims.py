"""What sessions tell of the mesh clock: its bytes, and numbers that would poison it."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mesh_world import World

from services.mesh.core.link.clock import ClockClaim, ClockSync, decode_claim, encode_claim
from services.mesh.core.wire import frames
from swarm.errors import FrameError

claims = st.builds(
    ClockClaim,
    root=st.from_regex(r"[a-z][a-z0-9_-]{0,15}", fullmatch=True),
    incarnation=st.integers(0, 2**32 - 1),
    epoch=st.integers(0, 2**32 - 1),
    hop=st.integers(0, 255),
    child=st.booleans(),
    settled=st.booleans(),
    at=st.integers(0, 2**40).map(lambda microseconds: microseconds * 1e-6),
    offset=st.floats(-1e10, 1e10),
    rate=st.floats(-(2.0**-11), 2.0**-11, width=32),
    error=st.floats(0.0, 1e9, width=32),
)


@given(claims)
def test_clock_claims_survive_encoding(claim: ClockClaim) -> None:
    decoded = decode_claim(encode_claim(claim)[3:])
    assert decoded._replace(at=0.0) == claim._replace(at=0.0)
    assert decoded.at == pytest.approx(claim.at, abs=2e-6)


@given(st.binary(max_size=80))
def test_any_bytes_raise_frame_errors_only(body: bytes) -> None:
    with suppress(FrameError):
        decode_claim(body)


@pytest.mark.parametrize("field", ["offset", "rate", "error"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_numbers_that_would_poison_the_clock_are_refused(field: str, value: float) -> None:
    claim = ClockClaim("r0", 1, 1, 0, False, True, 1.0, 0.0, 0.0, 0.0)._replace(**{field: value})
    with pytest.raises(FrameError, match="out of bounds"):
        decode_claim(encode_claim(claim)[3:])


def test_robots_that_are_not_of_the_swarm_are_never_root() -> None:
    own = ClockSync("r1", 1, frozenset(("r1", "r2")))
    own.sample("r2", 1.0, 0.06, 5.0)
    own.hear("r2", ClockClaim("a0", 1, 9, 0, False, True, 6.0, 0.0, 0.0, 0.0), 1.0)
    assert own.state(1.1).root == "r1"


def test_sessions_carry_the_mesh_clock() -> None:
    world = World([("r0", "r1"), ("r1", "r2")])
    world.run(20.0)
    states = [world.bots[name].node.connections.clock.state(world.now) for name in ("r0", "r1", "r2")]
    assert [(state.root, state.hop) for state in states] == [("r0", 0), ("r0", 1), ("r0", 2)]
    # All robots of this world share one monotonic clock.
    assert all(abs(state.offset) < 1e-3 for state in states)
    world.kill("r0")
    world.run(8.0)
    assert [world.bots[name].node.connections.clock.state(world.now).root for name in ("r1", "r2")] == ["r1", "r1"]


def test_a_clock_frame_is_short() -> None:
    claim = ClockClaim("r0", 1, 1, 0, False, True, 1.0, 0.0, 0.0, 0.0)
    assert len(encode_claim(claim)) + frames.TAG_SIZE <= 48
