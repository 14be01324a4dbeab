"""Accidents on the link of two robots, drawn by Hypothesis, and their end."""

from typing import Any

from hypothesis import strategies as st
from mesh_world import World

ACCIDENTS = st.one_of(
    st.tuples(st.just("publish"), st.sampled_from(("r0", "r1"))),
    st.tuples(st.just("cut"), st.floats(0.1, 12.0)),
    st.tuples(st.just("break"), st.integers(1, 200)),
    st.tuples(st.just("drop"), st.sampled_from(("r0", "r1"))),
    st.tuples(st.just("restart"), st.sampled_from(("r0", "r1"))),
    st.tuples(st.just("absent"), st.sampled_from(("r0", "r1"))),
    st.tuples(st.just("stop"), st.tuples(st.sampled_from(("r0", "r1")), st.floats(0.1, 9.0))),
    st.tuples(st.just("wait"), st.floats(0.001, 6.0)),
)
"""What may happen to the link of r0 and r1, for `suffer`; `publish` is the test's own matter."""


def suffer(world: World, kind: str, value: Any) -> None:
    """One of `ACCIDENTS`."""
    match kind:
        case "cut":
            world.cut("r0", "r1", value)
        case "break":
            world.break_after = value
        case "drop" if value in world.bots:
            world.break_connections(value)
        case "restart" | "absent":
            if value in world.bots:
                world.kill(value)
            if kind == "restart":
                world.start(value)
        case "stop" if value[0] in world.bots:
            world.stop(*value)
        case "wait":
            world.run(value)


def recover(world: World) -> None:
    """No more accidents: r0 and r1 run, and nothing breaks."""
    for name in ("r0", "r1"):
        if name not in world.bots:
            world.start(name)
    world.break_after = None
