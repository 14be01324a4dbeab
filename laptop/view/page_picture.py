"""A picture of the page as a file."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlencode

from laptop.view import chromium
from swarm.errors import LocalError

SIZE = (1400, 1000)
"""Size of the picture in pixels."""

SETTLE_S = 4.0
"""Seconds that a live page has to connect, and for trails and charts to grow."""

DRAWN_S = 1.0
"""Seconds within which all parts of the page have drawn what they know."""


async def take(address: str, path: Path, at: float | None, charts: Sequence[str]) -> None:
    """Write a PNG of the page at `address`, of a recording at the instant `at`, s. Raises `LocalError` where that
    fails."""
    query = urlencode([("chart", chart) for chart in charts])
    async with chromium.opened(f"{address}&{query}", SIZE) as page:
        await page.until("Boolean(window.swarmView?.store.swarm)")
        if at is not None:
            await page.evaluate(f"swarmView.player.seek({at!r})")
        await asyncio.sleep(SETTLE_S if at is None else DRAWN_S)
        await page.evaluate("swarmView.settled()")
        await asyncio.sleep(DRAWN_S)
        await page.until(
            "document.querySelector('#connection').textContent !== 'server lost'"
        )  # a busy machine may lose it for a while
        picture = await page.picture()
    try:
        path.write_bytes(picture)
    except OSError as error:
        raise LocalError(f"{path}: {error.strerror}") from None
