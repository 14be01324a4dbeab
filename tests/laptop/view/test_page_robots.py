"""The page of real robots in a real browser: one behind an ssh server, the others over real meshes, with a real app."""

import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from browsing import PATIENCE_MS, chromium, event, row, shown, until
from conftest import Processes, wait_until
from remote_swarm import Swarm, real_page

from swarm.messages import Pose

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

pytestmark = real_page

APP = """
from swarm import SyncApp, parameter

class Mine(SyncApp):
    value: float
    gain: float = parameter(0.5, low=0, high=1, live=True)

    def step(self, neighbours):
        self.value += self.gain * sum(w * (n.value - self.value) for w, n in self.weighted(neighbours))
"""


@pytest.fixture
def swarm(processes: Processes, tmp_path: Path) -> Iterator[Swarm]:
    swarm = Swarm(processes, tmp_path)
    for name in ("r0", "r1", "r2"):
        swarm.add(name, ssh=name == "r0")
    swarm.start_meshes()
    app = tmp_path / "mine.py"
    app.write_text(APP)
    for name in swarm.buses:
        swarm.start(name, "services.apps", app, "--run", "1")
    swarm.far.ready()
    yield swarm
    swarm.close()


def test_robots_that_live_obey_leave_and_are_out_of_reach(swarm: Swarm) -> None:
    options = ("--robots", "r0", "--config", swarm.far.config, "--ssh-config", swarm.far.ssh_config, "--control")
    with chromium() as browser, shown(browser, *options) as page:
        expect(page.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)
        for robot, links in (("r0", "1/1"), ("r1 (mesh)", "2/2"), ("r2 (mesh)", "1/1")):
            line = row(page, robot[:2])
            for said in (robot, links, "2 ok", "mine running"):
                expect(line).to_contain_text(said, timeout=PATIENCE_MS)
        until(page, "swarmView.store.get('r2', 'app/mine/state')?.k > 0")
        k = page.evaluate("swarmView.store.get('r2', 'app/mine/state').k")
        until(page, f"swarmView.store.get('r2', 'app/mine/state').k > {k + 10}")

        def placed() -> bool:
            for number, (robot, bus) in enumerate(swarm.buses.items()):
                pose = Pose(1.0, 7, float(number), 2.5, 0.5, 80, "ekf", 0.05, 0.06, 0.1, 0.02)
                bus.publish(f"swarm/{robot}/dwm/pose", pose)
            return page.evaluate("swarmView.store.places.size === 3")

        wait_until(placed, what="all robots have their places")

        # Its parameters are set, and nothing else is laid on a real robot.
        row(page, "r0").click()
        gain = page.get_by_label("mine gain")
        gain.fill("0.75", timeout=PATIENCE_MS)
        gain.press("Enter")
        said = page.locator("#said")
        expect(said).to_have_text("mine: gain=0.75 asked of r0 r1 r2", timeout=PATIENCE_MS)
        for robot in ("r1", "r2"):  # no ssh leads there
            expect(event(page, robot, "mine: gain=0.75 was not set: ")).to_be_visible(timeout=PATIENCE_MS)
        until(page, "swarmView.store.get('r0', 'app/mine/parameters').parameters.gain.value === 0.75")
        gain.fill("77")
        gain.press("Enter")
        expect(said).to_have_class("bad", timeout=PATIENCE_MS)
        expect(said).to_contain_text("r0: ")
        assert page.locator("#controls").get_by_role("button", name=re.compile("press|push|lay")).count() == 0

        page.locator("#stop").click()
        expect(page.locator("#stop")).to_have_text("STOPPED 3/3", timeout=PATIENCE_MS)
        page.locator("#arm").click()
        expect(page.locator("#stop")).to_have_text("STOP", timeout=PATIENCE_MS)

        # One leaves: it is named, and so is who waits for it.
        swarm.meshes["r2"].kill()
        expect(row(page, "r2")).to_contain_text("out of reach: the mesh has lost it", timeout=PATIENCE_MS)
        expect(event(page, "r2", "out of reach")).to_be_visible()
        expect(row(page, "r1")).to_contain_text("waiting", timeout=PATIENCE_MS)
        expect(page.locator("#lockstep p")).to_contain_text("r1 waits for r2", timeout=PATIENCE_MS)

        # And then nobody is reached: the ssh server refuses.
        swarm.far.close()
        os.kill(swarm.lookout("r0"), signal.SIGKILL)
        expect(row(page, "r0")).to_contain_text("out of reach: it runs no ssh server", timeout=PATIENCE_MS)
        expect(page.locator("#connection")).to_have_text("no robot in reach", timeout=PATIENCE_MS)
        page.locator("#stop").click()
        expect(said).to_contain_text("no robot is reached by ssh", timeout=PATIENCE_MS)
