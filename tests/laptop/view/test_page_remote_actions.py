"""What the page of real robots does to them, in a real browser: a robot behind an ssh server, one that the mesh alone
brings, and one whose ssh server refuses. Their services start again as under systemd."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import PATIENCE_MS, chromium, event, row, shown, until
from conftest import Processes
from remote_swarm import Swarm, real_page

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

pytestmark = real_page


@pytest.fixture
def swarm(processes: Processes, tmp_path: Path) -> Iterator[Swarm]:
    swarm = Swarm(processes, tmp_path)
    for name in ("r0", "r1", "r2"):
        swarm.add(name, ssh=name != "r2")
    for name in ("r0", "r1"):
        swarm.supervise(name)
    swarm.start_meshes()
    swarm.far.ready()
    yield swarm
    swarm.close()


def told(page: Any, robot: str, text: str) -> None:
    expect(event(page, robot, text)).to_be_visible(timeout=PATIENCE_MS)


def click(page: Any, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click(timeout=PATIENCE_MS)


def test_apps_links_and_services_of_real_robots(swarm: Swarm) -> None:
    options = ("--robots", "r0", "--config", swarm.far.config, "--ssh-config", swarm.far.ssh_config)
    with chromium() as browser, shown(browser, *options, "--control") as page:
        expect(page.locator("#connection")).to_have_text("live", timeout=PATIENCE_MS)
        for robot, links in (("r0", "1/1"), ("r1", "2/2"), ("r2", "1/1")):
            expect(row(page, robot)).to_contain_text(links, timeout=PATIENCE_MS)

        page.get_by_label("app to start").fill("consensus", timeout=PATIENCE_MS)
        click(page, "start on all")
        expect(page.locator("#said")).to_contain_text("consensus: to be started on r0 r1 r2", timeout=PATIENCE_MS)
        told(page, "r2", "consensus was not started: it runs no ssh server")
        told(page, "r0", "consensus was started")
        told(page, "r1", "consensus was started")
        for robot in ("r0", "r1"):
            until(page, f"swarmView.store.services.{robot}?.['app/consensus']")

        # What a real robot's people do themselves is not offered.
        row(page, "r0").click()
        expect(page.get_by_role("button", name="kill app/consensus")).to_be_visible(timeout=PATIENCE_MS)
        assert page.locator("#controls").get_by_role("button", name=re.compile("press|push|lay")).count() == 0

        click(page, "cut r1")
        until(page, "swarmView.store.link('r0', 'r1')?.state === 'down'")
        told(page, "r0", "link down: held down on command")
        click(page, "mend r1")
        until(page, "swarmView.store.link('r0', 'r1')?.state === 'up'")

        click(page, "kill mesh")
        told(page, "r0", "mesh was killed")
        told(page, "r0", "mesh is gone")
        told(page, "r0", "mesh is back")
        until(page, "swarmView.store.link('r0', 'r1')?.state === 'up'")

        # Of a robot that the page sees over the mesh alone, with one end that cannot be told.
        row(page, "r1").click()
        click(page, "cut r2")
        told(page, "r2", "it cannot be told to cut the link r1 - r2: it runs no ssh server")
        until(page, "swarmView.store.link('r1', 'r2')?.state === 'down'")
        click(page, "mend r2")
        until(page, "swarmView.store.link('r1', 'r2')?.state === 'up'")
        click(page, "kill app/consensus")
        told(page, "r1", "consensus was killed")

        click(page, "stop consensus on all")
        told(page, "r2", "consensus was not stopped: it runs no ssh server")
        for robot in ("r0", "r1"):
            told(page, robot, "consensus was stopped")
            until(page, f"!swarmView.store.services.{robot}?.['app/consensus']")

    # Another page offers what was started before, and one without --control nothing.
    with chromium() as browser, shown(browser, *options, "--control") as page:
        click(page, "start consensus on all")
        told(page, "r1", "consensus was started: it goes on where it was")
        until(page, "swarmView.store.services.r1?.['app/consensus']")
    with chromium() as browser, shown(browser, *options) as page:
        row(page, "r0").click(timeout=PATIENCE_MS)
        expect(page.locator("#keys h2")).to_have_text("swarm/r0")
        for each in ("#stop", "#apps", "#controls"):
            expect(page.locator(each)).to_be_hidden()
        page.evaluate("""() => {
          const socket = new WebSocket(`ws://${location.host}/live${location.search}`);
          socket.onopen = () => socket.send(JSON.stringify({do: {act: "end", app: "consensus"}}));
          socket.onmessage = ({data}) => (globalThis.answer ??= JSON.parse(data).refused);
        }""")
        until(page, "globalThis.answer?.includes('only watches')")
