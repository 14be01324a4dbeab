"""`swarm film`: which instants it shows, what it refuses, and the file that comes out."""

import argparse
import asyncio
import itertools
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from browsing import CHROMIUM
from hypothesis import given
from hypothesis import strategies as st
from virtual_run import recorded

pytest.importorskip("aiohttp", reason="the lab extra is not installed")

from laptop.cli.runs import film as verb
from laptop.view import chromium
from laptop.view.film import MAX_FRAMES, Film, encoder
from swarm.errors import LocalError

BAD = (0xC0, 0x26, 0x2D)
"""The page's colour of what is bad, in light."""
FPS, SPEED = 10, 2.0


def rig(test: Callable[..., None]) -> Callable[..., None]:
    """A test that needs browser and encoder, and its time."""
    there = CHROMIUM is not None and shutil.which("ffmpeg") is not None
    test = pytest.mark.skipif(not there, reason="no chromium or ffmpeg: apt-get install chromium ffmpeg")(test)
    return pytest.mark.slow(pytest.mark.timeout(300)(test))


@given(st.floats(-10.0, 10.0), st.floats(0.01, 60.0), st.sampled_from([1.0, 24.0, 30.0, 59.94]), st.floats(0.1, 100.0))
def test_pictures_are_as_far_apart_as_film_and_speed_want_it(
    begin: float, length: float, fps: float, speed: float
) -> None:
    instants = Film(begin, begin + length, fps=fps, speed=speed).instants()
    assert instants[0] == begin
    assert instants[-1] <= begin + length
    assert len(instants) == max(1, round(length / speed * fps))
    step = speed / fps
    assert all(abs(b - a - step) <= 1e-6 * step + 1e-9 for a, b in itertools.pairwise(instants))


def test_a_slip_of_the_hand_does_not_fill_the_disk() -> None:
    with pytest.raises(LocalError, match=f"at most {MAX_FRAMES}"):
        Film(0.0, 1e9).instants()


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(LocalError, match="apt-get install ffmpeg"):
        encoder()
    with pytest.raises(LocalError, match="apt-get install chromium"):
        chromium.browser()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    recorded(folder, "consensus", "--robots", "6", "--topology", "line", "--seconds", "10", "--cut", "r2-r3@2s,7s")
    return folder


def arguments(*words: object) -> Any:
    parser = argparse.ArgumentParser(exit_on_error=False)
    verb.add_arguments(parser)
    return parser.parse_args([str(word) for word in words])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["x.avi"], "ends in .mp4 or .webp"),
        (["nowhere/x.mp4"], "no such folder"),
        (["x.mp4", "--size", "641x480"], "both even"),
        (["x.mp4", "--size", "big"], "both even"),
        (["x.mp4", "--size", "99998x480"], "160 to 4096"),
        (["x.mp4", "--fps", "0"], "1 to 120"),
        (["x.mp4", "--fps", "nan"], "1 to 120"),
        (["x.mp4", "--speed", "0"], "0.001 to 1000"),
        (["x.mp4", "--from", "5", "--to", "4"], "nothing between"),
        (["x.mp4", "--from", "1e6"], "nothing between"),
        (["x.mp4", "--chart", "value"], "TOPIC:FIELD"),
        (["x.mp4", "--chart", "app/consensus/state:state.valu"], "no robot has such a number"),
        (["x.mp4", "--chart", "app/consensus/states:k"], "the topics are .*app/consensus/state"),
    ],
)
def test_bad_wishes_are_refused_before_anything_is_drawn(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], said: str
) -> None:
    monkeypatch.setattr("laptop.view.film.encoder", lambda: "ffmpeg")
    monkeypatch.setattr(chromium, "browser", lambda: "chromium")
    with pytest.raises((LocalError, argparse.ArgumentError), match=said):
        verb.run(arguments(run, tmp_path / options[0], *options[1:]))
    assert list(tmp_path.iterdir()) == []


def probe(film: Path) -> dict[str, Any]:
    """What ffprobe finds in the file; it counts the pictures by decoding them."""
    fields = "stream=codec_name,width,height,nb_read_frames,duration"
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_entries", fields, "-of", "json", str(film)]
    (stream,) = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)["streams"]
    return stream


def bad_pixels(film: Path, number: int) -> int:
    """How many pixels of a picture are in the colour of what is bad."""
    command = ["ffmpeg", "-v", "error", "-i", str(film), "-vf", f"select=eq(n\\,{number})", "-frames:v", "1"]
    data = subprocess.run(
        [*command, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], check=True, capture_output=True
    ).stdout
    assert len(data) == 960 * 540 * 3
    pixels = zip(data[::3], data[1::3], data[2::3], strict=True)
    return sum(all(abs(one - other) < 15 for one, other in zip(pixel, BAD, strict=True)) for pixel in pixels)


@rig
def test_a_film_has_the_pictures_it_should(run: Path, tmp_path: Path) -> None:
    film = tmp_path / "run.mp4"
    command = [sys.executable, "-m", "laptop.cli", "film", str(run), str(film), "--from", "1.9", "--to", "9.1"]
    options = ["--fps", str(FPS), "--speed", str(SPEED), "--size", "960x540"]
    done = subprocess.run([*command, *options], check=True, capture_output=True, text=True, timeout=200)
    assert done.stdout == f"{film}\n"
    assert "36/36 pictures" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.mp4"]
    found = probe(film)
    assert (found["codec_name"], found["width"], found["height"]) == ("h264", 960, 540)
    assert int(found["nb_read_frames"]) == 36  # 7.2 s, twice as fast, ten a second
    assert float(found["duration"]) == pytest.approx(3.6, abs=0.01)
    # The link is cut at 2 s and mends at 9: before nothing is red, at the end its line is, and all who wait.
    assert bad_pixels(film, 0) < 20
    assert bad_pixels(film, 35) > 300


@rig
def test_an_encoder_that_fails_is_quoted_and_leaves_nothing(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho no such codec >&2\nexit 7\n")
    broken.chmod(0o755)
    monkeypatch.setattr("laptop.view.film.encoder", lambda: str(broken))
    monkeypatch.setattr(verb.signal, "SIGTERM", verb.signal.SIGUSR1)  # the loop must not take the test's own
    with pytest.raises(LocalError, match="ended with code 7: no such codec"):
        verb.run(arguments(run, tmp_path / "x.mp4", "--to", "1", "--size", "320x240"))
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


@rig
def test_a_page_that_fails_is_quoted() -> None:
    async def main() -> None:
        async with chromium.opened("about:blank", (320, 240)) as page:
            assert await page.evaluate("Promise.resolve(6 * 7)") == 42
            assert (await page.picture()).startswith(b"\x89PNG")
            with pytest.raises(LocalError, match="ReferenceError: nothing is not defined"):
                await page.evaluate("nothing.at.all")

    asyncio.run(main())
