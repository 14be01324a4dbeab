"""Pictures and films that a page asks for: a browser of the server's own shows the page and writes what is seen."""

import asyncio
import tempfile
from functools import partial
from pathlib import Path
from urllib.parse import urlencode

from aiohttp import web

from laptop.view.recording import ViewedRecording
from swarm.errors import LocalError

_BUSY: web.AppKey[asyncio.Lock] = web.AppKey("busy")
_SHOWN = ("token", "theme", "run")
"""Parameters of the address that the page in the picture gets, too."""


def add_camera(app: web.Application, recording: ViewedRecording | None) -> None:
    """Give a server of pages the addresses `/picture` and, of a recording, `/film`."""
    app[_BUSY] = asyncio.Lock()
    app.router.add_get("/picture", partial(_make, name="page.png"))
    if recording is not None:
        app.router.add_get("/film", partial(_make, name="page.mp4"))


async def _make(request: web.Request, name: str) -> web.StreamResponse:
    """Answer with the file, or with the reason why there is none."""
    busy = request.app[_BUSY]
    if busy.locked():
        raise web.HTTPConflict(text="another one is being made")
    try:
        from laptop.view import film, page_picture  # they drive Chromium, over pipes that only Unix has
    except ModuleNotFoundError as error:
        raise web.HTTPServiceUnavailable(text=f"pictures need {error.name}, which this system has not") from None
    asked = request.query
    shown = urlencode([(part, asked[part]) for part in _SHOWN if part in asked])
    address = f"http://{request.host}/?{shown}"
    charts = tuple(asked.getall("chart", ()))
    async with busy:
        with tempfile.TemporaryDirectory(prefix="swarm-view-") as folder:
            path = Path(folder) / name
            try:
                if path.suffix == ".png":
                    await page_picture.take(address, path, float(asked["at"]) if "at" in asked else None, charts)
                else:
                    begin, end = float(asked["from"]), float(asked["to"])
                    wanted = film.Film(begin, end, charts=charts, theme=asked.get("theme", "light"))
                    await film.shoot(address, wanted, path, lambda *_: None)
            except LocalError as error:
                raise web.HTTPServiceUnavailable(text=str(error)) from None
            except (KeyError, ValueError):
                raise web.HTTPBadRequest(text="expected seconds: at, or from and to") from None
            kind = "image/png" if path.suffix == ".png" else "video/mp4"
            return web.Response(body=path.read_bytes(), content_type=kind)
