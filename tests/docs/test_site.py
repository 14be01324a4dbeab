"""The documentation site, opened from its folder as a reader without a network does."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from swarm import __version__
from tests.browsing import PATIENCE_MS, chromium

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: ./run site installs it")
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as it:
        yield it


@pytest.fixture
def page(site: Path, browser: Any) -> Iterator[Any]:
    with browser.new_context() as context:
        it = context.new_page()
        it.set_default_timeout(PATIENCE_MS)
        asked: list[str] = []
        it.on("request", lambda request: asked.append(request.url))
        it.goto((site / "index.html").as_uri())
        yield it
        assert [url for url in asked if not url.startswith("file:")] == []


def test_pages_have_the_version(page: Any) -> None:
    assert __version__ in page.inner_text("header")


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("max-consensus", "how-to/apps/max-consensus.html"),
        ("waits for r3", "how-to/runs/find-who-waits.html"),
        ("second app", "how-to/apps/run-several-apps.html"),
        ("windows", "how-to/simulation/other-systems.html"),
    ],
)
def test_search_finds_the_page_of_a_task_first(page: Any, words: str, found: str) -> None:
    page.click(".md-search__input")
    page.keyboard.type(words)
    page.click(".md-search-result__link >> nth=0")
    page.wait_for_url(f"**/{found}*")
