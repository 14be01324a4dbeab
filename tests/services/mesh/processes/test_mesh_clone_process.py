"""A second robot with the name, key and configuration of r0, as real processes over TCP."""

from pathlib import Path

import pytest
from conftest import wait_until
from mesh_rig import SYNC, Build, Robot, Swarm, build, log_of

from bench.rigs.ports import free_port
from swarm.config.keyfile import new_key_file
from swarm.messages import read
from swarm.onboard.mesh import show, tables

__all__ = ["build"]


class Copy(Robot):
    """A robot that calls itself as another one; its files are in a directory of its own."""

    def __init__(self, swarm: Swarm, of: str) -> None:
        super().__init__(swarm, of + "-copy")
        text = swarm[of].config.read_text()
        self.config.write_text(
            text.replace(f'listen = "127.0.0.1:{swarm.ports[of]}"', f'listen = "127.0.0.1:{free_port()}"')
        )
        self.name = of
        self.bus.subscribe(f"swarm/{of}/mesh/links", self._on_links)


@pytest.fixture
def swarm(build: Build, runtime: Path) -> Swarm:
    key = runtime / "key"
    new_key_file(key, 1000.0)
    return build("tcp", (("r0", "r1"), ("r1", "r2")), key=key)


@pytest.mark.slow
def test_a_copy_of_a_robot_takes_no_link_and_is_named_everywhere(swarm: Swarm) -> None:
    swarm.start()
    swarm.talk("r0", "r1")
    copy = Copy(swarm, "r0")
    clashes: dict[str, dict[str, str]] = {}
    everybody = {**swarm.robots, "copy": copy}
    for name, robot in everybody.items():

        def take(key: str, payload: bytes, name: str = name) -> None:
            clashes[name] = read(key, payload).clashes  # type: ignore[attr-defined]

        robot.bus.subscribe(f"swarm/{robot.name}/mesh/links", take)
    copy.start()
    try:
        wait_until(lambda: all(set(clashes.get(name, {})) == {"r0"} for name in everybody), what="all name the clash")
        assert swarm["r1"].links["r0"].connection == 1
        assert "another robot with this name" in copy.links["r1"].reason
        swarm["r1"].samples.clear()
        copy.bus.publish(SYNC.format("r0"), b"from the copy")
        swarm.talk("r0", "r1")
        swarm.talk("r2", "r1")
        assert b"from the copy" not in {payload for _, payload in swarm["r1"].samples}
        seen = show.collect({"r2": swarm["r2"].directory})
        assert not seen.whole
        assert tables.text(seen)[0].startswith("WRONG: another robot is called r0, too: r1 ")
        assert copy.mesh is not None
        log = log_of(copy.mesh)
        assert log.count("another robot is called r0, too") == 1
        wait_until(lambda: swarm["r1"].links["r0"].connection == 1)
    finally:
        copy.close()
    scene_record = swarm["r1"].mesh
    assert scene_record is not None
    log = log_of(scene_record)
    assert log.count("another robot is called r0, too") == 1
    assert log.count("WARNING") <= 2
    assert "Traceback" not in log
