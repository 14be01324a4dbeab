"""The key of real meshes is replaced robot by robot while the swarm runs, over TCP."""

from pathlib import Path

import pytest
from conftest import stop, wait_until
from mesh_rig import Build, Swarm, build

from swarm.config.keyfile import new_key_file, retire, rotate
from swarm.messages import Arm, Stop, read

__all__ = ["build"]

EDGES = (("r0", "r1"), ("r1", "r2"))


def stop_reaches_all(swarm: Swarm, giver: str) -> None:
    """Give a stop on one robot, wait until each mesh says that it holds, and take it back."""
    held: dict[str, bool] = {}
    for name, robot in swarm.robots.items():

        def take(key: str, payload: bytes, name: str = name) -> None:
            held[name] = read(key, payload).stopped  # type: ignore[attr-defined]

        robot.bus.subscribe(f"swarm/{name}/mesh/stopped", take)
    swarm[giver].bus.publish("swarm/stop", Stop(1.0, giver, "smoke"))
    wait_until(lambda: held == dict.fromkeys(swarm.robots, True), what="the stop holds everywhere")
    swarm[giver].bus.publish(f"swarm/{giver}/mesh/set/arm", Arm(1.0, giver))
    wait_until(lambda: held == dict.fromkeys(swarm.robots, False), what="it is taken back")


@pytest.mark.slow
def test_a_rotation_of_keys_leaves_no_robot_alone_and_stops_reach_all(build: Build, runtime: Path) -> None:
    key = runtime / "key"
    new_key_file(key, 1000.0)
    swarm = build("tcp", EDGES, key=key)
    for name, robot in swarm.robots.items():
        own = runtime / f"{name}.key"
        own.write_bytes(key.read_bytes())
        own.chmod(0o600)
        robot.config.write_text(robot.config.read_text().replace(str(key), str(own)))
    swarm.start()
    for step in (lambda: rotate(key, 2000.0), lambda: retire(key)):
        step()
        for name in ("r1", "r0", "r2"):
            (runtime / f"{name}.key").write_bytes(key.read_bytes())
            mesh = swarm[name].mesh
            assert mesh is not None
            assert stop(mesh) == 0
            swarm[name].links.clear()
            swarm[name].start()
            swarm.wait_up()
            stop_reaches_all(swarm, name)
            swarm.talk("r0", "r1")
            swarm.talk("r2", "r1")
    for robot in swarm.robots.values():
        assert "refused_key" not in robot.status().counters
