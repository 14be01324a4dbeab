"""`swarm mesh` beside a real mesh whose messages have fields of a later release."""

import os
from pathlib import Path

import msgpack
from conftest import Processes, wait_until
from mesh_rig import Build, build

from swarm.onboard.mesh import show, tables

__all__ = ["build"]

LATER = """
import dataclasses, runpy
from swarm.messages import codec

plain = codec._plain


def with_more(value):
    fields = plain(value)
    return {**fields, "of_a_later_release": 1} if dataclasses.is_dataclass(value) else fields


codec._plain = with_more
codec.encode.__globals__["_plain"] = with_more
runpy.run_module("services.mesh", run_name="__main__")
"""
"""A mesh of a later release: each message that it packs has one more field, at each depth."""


def test_a_robot_with_a_later_release_is_shown_and_linked(build: Build, processes: Processes) -> None:
    swarm = build("tcp", (("r0", "r1"),))
    swarm["r0"].start()
    said: list[dict[str, object]] = []
    later = swarm["r1"]
    later.bus.subscribe("swarm/r1/mesh/links", lambda key, payload: said.append(msgpack.unpackb(payload)))
    processes.start_ready(
        "-c",
        LATER,
        SWARM_ROBOT="r1",
        SWARM_RUNTIME=os.fspath(later.directory),
        SWARM_CONFIG=os.fspath(later.config),
        SWARM_SIM_LINK="",
    )
    swarm.wait_up()
    swarm.talk("r1", "r0")
    wait_until(lambda: bool(said), what="the later release says how its links are")
    assert "of_a_later_release" in said[-1]
    seen = show.collect({name: Path(robot.directory) for name, robot in swarm.robots.items()})
    assert seen.whole
    assert "2 robots, 1 of 1 links up" in "\n".join(tables.text(seen))
