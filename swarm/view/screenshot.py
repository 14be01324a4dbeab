"""A picture of the page without a person: by the Chromium or Chrome of this machine."""

import asyncio
import shutil
import tempfile
from pathlib import Path

from swarm.errors import LocalError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SIZE = (1400, 1000)
"""Pixels."""

_TIMEOUT_S = 60.0


def browser() -> str:
    """The browser to use; `LocalError` where there is none."""
    for name in BROWSERS:
        if (path := shutil.which(name)) is not None:
            return path
    raise LocalError(f"no {', '.join(BROWSERS)} found: apt-get install chromium")


async def take(address: str, path: Path) -> None:
    """Write a PNG of the page at `address`. Raises `LocalError` where that fails."""
    with tempfile.TemporaryDirectory(prefix="swarm-view-") as profile:
        process = await asyncio.create_subprocess_exec(
            browser(),
            "--headless=new",
            "--no-sandbox",  # as root it does not start otherwise; it sees our own page only
            "--hide-scrollbars",
            f"--user-data-dir={profile}",
            f"--window-size={SIZE[0]},{SIZE[1]}",
            f"--screenshot={path.absolute()}",
            f"{address}&settle",
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            _, errors = await asyncio.wait_for(process.communicate(), _TIMEOUT_S)
        except TimeoutError:
            process.kill()
            await process.wait()
            raise LocalError(f"the browser took more than {_TIMEOUT_S:g} s") from None
        if process.returncode != 0 or not path.exists():
            raise LocalError(f"no picture: {errors.decode(errors='replace').strip()[-300:]}")
