"""A film of a recorded run: pictures of the page at exact instants of the recording, which ffmpeg makes a file."""

import asyncio
import contextlib
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlencode

from laptop.view import chromium
from swarm.errors import LocalError
from swarm.frozen import frozen

ENCODER = "ffmpeg"
FORMATS = {
    ".mp4": "-c:v libx264 -crf 18 -pix_fmt yuv420p -movflags +faststart -f mp4",
    ".webp": "-c:v libwebp_anim -quality 60 -compression_level 6 -loop 0 -f webp",
}
"""Options of the encoder by the file's suffix: a film, or an animated picture that a page of text can show."""

DESK = 1280
"""Width in pixels of the page that a film shows. A narrower film shows the page smaller."""

MAX_FRAMES = 200_000
"""The most pictures of a film, some two hours. More are probably a mistake."""


@frozen
class Film:
    """The content of a film, and how it is shown."""

    begin: float
    """Beginning of the film, in seconds of the recording."""
    end: float
    """End of the film, in seconds of the recording."""
    size: tuple[int, int] = (1280, 720)
    """Width and height in pixels. Both are even, as the encoder requires."""
    fps: float = 30.0
    """Pictures a second."""
    speed: float = 1.0
    """Seconds of the recording in a second of the film."""
    charts: Sequence[str] = ()
    """`TOPIC:FIELD.FIELD`"""
    theme: str = "light"

    def instants(self) -> list[float]:
        """Return the instants of the film's pictures, s of the recording: at least one, and none behind the end."""
        count = max(1, round((self.end - self.begin) / self.speed * self.fps))
        if count > MAX_FRAMES:
            raise LocalError(f"{count} pictures: at most {MAX_FRAMES}; use --from, --to, --speed or --fps")
        return [min(self.end, self.begin + index * self.speed / self.fps) for index in range(count)]


def encoder() -> str:
    """Return the program that encodes. Raises `LocalError` where there is none."""
    if (path := shutil.which(ENCODER)) is None:
        raise LocalError(f"no {ENCODER} found, which makes pictures a film: apt-get install {ENCODER}")
    return path


async def shoot(address: str, film: Film, path: Path, tell: Callable[[int, int], None]) -> None:
    """Write the film of the page at `address`, and call `tell(done, all)` after each picture. Raises `LocalError`.

    The file appears when it is whole; its suffix is one of `FORMATS`.
    """
    instants, program = film.instants(), encoder()
    part = path.with_name(f".{path.name}.part")
    query = urlencode([("theme", film.theme), *(("chart", chart) for chart in film.charts)])
    process = await asyncio.create_subprocess_exec(
        program,
        "-loglevel",
        "error",
        "-y",
        "-f",
        "image2pipe",
        "-framerate",
        f"{film.fps:g}",
        "-c:v",
        "png",
        "-i",
        "-",
        *FORMATS[path.suffix].split(),
        str(part),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    assert process.stdin is not None
    assert process.stderr is not None
    errors = asyncio.create_task(process.stderr.read())
    try:
        try:
            scale = min(1.0, film.size[0] / DESK)
            async with chromium.opened(f"{address}&directed&{query}", film.size, scale) as page:
                await page.until("Boolean(window.swarmView?.store.swarm)")
                for number, t in enumerate(instants, 1):
                    await page.evaluate(f"swarmView.show({t!r})")
                    process.stdin.write(await page.picture())
                    await process.stdin.drain()
                    tell(number, len(instants))
            process.stdin.close()
            code = await process.wait()
        except ConnectionError:  # the encoder has ended
            code = await process.wait()
        if code != 0:
            said = (await errors).decode(errors="replace").strip().splitlines()
            raise LocalError(f"{path}: {ENCODER} ended with code {code}: {said[-1] if said else 'it says nothing'}")
        part.replace(path)
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
        await errors
        part.unlink(missing_ok=True)
