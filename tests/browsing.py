"""`swarm view` and a browser that shows its page."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from bench.rigs.running import running

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
PATIENCE_MS = 30_000


class View:
    """`swarm view ARGUMENTS`."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, "-m", "laptop.cli", "view", "--no-open", *map(str, arguments)]
        self._kept = tempfile.TemporaryDirectory()
        environment = os.environ | {"XDG_CONFIG_HOME": self._kept.name}  # not the layouts of whoever runs the tests
        self._stack = ExitStack()
        self._stack.callback(self._kept.cleanup)
        process = running(command, stdout=subprocess.PIPE, text=True, env=environment)
        self.process = self._stack.enter_context(process)
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()

    def close(self) -> None:
        """End it; safe to call twice."""
        self._stack.close()


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser without a window; the test is skipped where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no chromium: apt-get install chromium")
    sync_api.expect.set_options(timeout=PATIENCE_MS)
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def shown(browser: Any, *arguments: object, **options: Any) -> Iterator[Any]:
    """The page of `swarm view ARGUMENTS`; nothing may be complained of in it."""
    view = View(*arguments)
    try:
        with visit(browser, view, **options) as page:
            yield page
    finally:
        view.close()


@contextmanager
def visit(browser: Any, view: View, **options: Any) -> Iterator[Any]:
    """The page of a server that goes on; nothing may be complained of in it."""
    page = browser.new_page(**{"viewport": {"width": 1400, "height": 1000}, **options})
    problems: list[str] = []
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.view = view
    try:
        page.goto(view.address)
        yield page
    finally:
        page.close()
    # A server that the test has ended is complained of by the browser; nothing else may be.
    others = [text for text in problems if "WebSocket" not in text]
    assert others == [], others


def row(page: Any, robot: str) -> Any:
    """The row of a robot in the table."""
    return page.locator(f"tr[data-robot={robot}]")


def event(page: Any, robot: str, text: str) -> Any:
    """The newest line of events that tells this of a robot, be it alone or with others."""
    return page.locator("#events li", has_text=re.compile(rf"\b(all|{robot})\b.* {re.escape(text)}")).first


def until(page: Any, condition: str) -> None:
    """Wait for a condition of the page; its policy forbids the browser's own way, which is `eval`."""
    for _ in range(PATIENCE_MS // 50):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never: {condition}")


def seek(page: Any, t: float) -> None:
    """Show an instant of a recording."""
    until(page, "swarmView.store.swarm?.recording && swarmView.player.wanted !== undefined")
    page.evaluate(f"swarmView.player.go({t})")
    until(page, f"swarmView.store.t === {t}")
