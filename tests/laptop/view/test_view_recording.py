"""A recorded run on the page: at any instant, from any other one."""

import asyncio
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("aiohttp", reason="the lab extra is not installed")
from aiohttp.test_utils import TestClient, TestServer
from virtual_run import recorded

from laptop.view import film, page_picture
from laptop.view.layouts import Layouts
from laptop.view.playing import Playing
from laptop.view.recording import ViewedRecording
from laptop.view.server import application
from swarm.errors import LocalError, RecordingError


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    recorded(folder, "consensus", "--robots", "3", "--iterations", "60")
    return folder


@pytest.fixture(scope="module")
def recording(run: Path) -> ViewedRecording:
    return ViewedRecording(run)


def shown(page: dict[str, Any], step: dict[str, Any]) -> dict[str, Any]:
    """What a page shows after a step."""
    if step["fresh"]:
        page = {}
    for robot, topics in step["robots"].items():
        page.setdefault(robot, {}).update(topics)
    return page


@given(st.lists(st.floats(-1.0, 4.0), max_size=8), st.floats(-1.0, 4.0))
def test_an_instant_looks_the_same_wherever_one_comes_from(
    recording: ViewedRecording, way: list[float], end: float
) -> None:
    page: dict[str, Any] = {}
    since = None
    for t in (*way, end):
        page = shown(page, recording.step(since, t))
        since = t
    assert page == shown({}, recording.step(None, end))


def test_the_values_are_those_of_the_run(recording: ViewedRecording) -> None:
    page = shown({}, recording.step(None, recording.last))
    assert {robot: topics["app/consensus/state"]["k"] for robot, topics in page.items()} == {
        "r0": 60,
        "r1": 60,
        "r2": 60,
    }
    rows = recording.series("app/consensus/state", [("state", "value")])["r0"]
    assert [k for _, k, _ in rows] == list(range(61))
    assert all(isinstance(topics["mesh/links"]["links"], list) for topics in page.values())
    assert recording.config is not None
    assert {"x", "deviation_x"} <= page["r0"]["dwm/pose"].keys()
    assert "timestamp" not in page["r0"]["dwm/pose"], "what Foxglove reads says our own fields once more"


def test_numbers_of_charts_are_found_in_messages_that_are_not_prepared_for_a_page(
    recording: ViewedRecording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That takes two thirds of the time, and a chart of 200 robots is made of 20 000 messages."""
    prepared: list[object] = []
    monkeypatch.setattr("laptop.view.recording.json_value", lambda value: prepared.append(value) or value)
    assert len(recording.series("dwm/pose", [("x",)])["r0"]) > 10
    assert prepared == []
    recording.step(None, recording.last)
    newest = sum(len(topics) for topics in recording._rows.values())
    assert len(prepared) <= newest, "one message of each key, and none of the trails"
    assert not any("left out" in text for _, _, text in recording.marks())


def test_a_robot_that_is_switched_off_is_shown_as_gone(tmp_path: Path) -> None:
    recorded(tmp_path, "stand_up", "--robots", "2", "--seconds", "8", "--off", "r1@2s,3s")
    recording = ViewedRecording(tmp_path)
    gone = {t: sorted(recording.step(None, t)["services"]) for t in (0.0, 1.0, 4.8, 7.0)}
    assert gone == {0.0: [], 1.0: [], 4.8: ["r1"], 7.0: []}


def test_a_torn_file_shows_what_is_whole_and_names_the_rest(run: Path, tmp_path: Path) -> None:
    whole = next(run.glob("*.mcap")).read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole[: len(whole) * 2 // 3])
    recording = ViewedRecording(tmp_path)
    assert any("cut off" in text for text in recording.damage)
    assert 0 < shown({}, recording.step(None, 1e9))["r0"]["app/consensus/state"]["k"] <= 60


def test_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no recording"):
        ViewedRecording(tmp_path)


def test_a_page_asks_for_instants_and_anything_else_is_refused(recording: ViewedRecording) -> None:
    async def main() -> None:
        async with TestClient(TestServer(application(recording, None, "token"), host="127.0.0.1")) as client:
            socket = await client.ws_connect("/live?token=token")
            first = await socket.receive_json(timeout=60)
            assert first["swarm"]["recording"]["last"] == recording.last
            assert first["swarm"]["acts"] == []
            for asked in (
                {"seek": 1},
                {"seek": {}},
                {"seek": {"t": "x"}},
                {"do": {"act": "stop"}},
                [],
                {"series": {}},
            ):
                await socket.send_json(asked)
                assert "refused" in await socket.receive_json(timeout=60)
            await socket.send_json({"seek": {"since": None, "t": 1.0}})
            step = await socket.receive_json(timeout=60)
            assert (step["t"], step["fresh"], set(step["robots"])) == (1.0, True, {"r0", "r1", "r2"})
            await socket.send_json({"series": {"topic": "app/consensus/state", "fields": [["state", "value"]]}})
            assert set((await socket.receive_json(timeout=60))["series"]["rows"]) == {"r0", "r1", "r2"}

    asyncio.run(main())


def test_a_page_plays_on_while_the_server_collects_numbers_for_its_charts(
    recording: ViewedRecording, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    series = recording.series
    monkeypatch.setattr(recording, "series", lambda *asked: go_on.wait(60.0) and series(*asked))

    async def main() -> None:
        async with TestClient(TestServer(application(recording, None, "token"), host="127.0.0.1")) as client:
            socket = await client.ws_connect("/live?token=token")
            await socket.receive_json(timeout=60)
            await socket.send_json({"series": {"topic": "app/consensus/state", "fields": [["state", "value"]]}})
            await socket.send_json({"seek": {"since": None, "t": 1.0}})
            assert (await socket.receive_json(timeout=60))["t"] == 1.0
            go_on.set()
            assert set((await socket.receive_json(timeout=60))["series"]["rows"]) == {"r0", "r1", "r2"}

    try:
        asyncio.run(main())
    finally:
        go_on.set()


def test_a_page_is_given_pictures_and_films_or_told_why_there_are_none(
    run: Path, recording: ViewedRecording, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, float | None, float | None]] = []

    async def take(address: str, path: Path, at: float | None, _: object) -> None:
        asked.append((address.partition("?")[2], at, None))
        path.write_bytes(b"a picture")

    async def shoot(address: str, wanted: film.Film, path: Path, _: object) -> None:
        asked.append((address.partition("?")[2], wanted.begin, wanted.end))
        raise LocalError("no ffmpeg found")

    monkeypatch.setattr(page_picture, "take", take)
    monkeypatch.setattr(film, "shoot", shoot)

    async def main() -> None:
        async with TestClient(TestServer(application(recording, None, "token"), host="127.0.0.1")) as client:
            query = {"token": "token", "theme": "dark", "run": run.name}
            picture = await client.get("/picture", params=query | {"at": "1.5"})
            assert (picture.status, picture.content_type) == (200, "image/png")
            assert await picture.read() == b"a picture"
            made = await client.get("/film", params=query | {"from": "0.5", "to": "2"})
            assert (made.status, await made.text()) == (503, "no ffmpeg found")
            assert (await client.get("/film", params=query | {"from": "soon"})).status == 400
            assert (await client.get("/picture")).status == 403

    asyncio.run(main())
    shown = f"token=token&theme=dark&run={run.name}"
    assert asked == [(shown, 1.5, None), (shown, 0.5, 2.0)]


def test_a_page_that_is_to_show_another_recording_of_the_folder_does(run: Path, recording: ViewedRecording) -> None:
    recorded(run.parent / "other", "consensus", "--robots", "3", "--iterations", "3")
    layouts = Layouts(run / "layouts.json")
    names = [
        Playing(recording, layouts, wanted).first()["swarm"]["recording"]["name"]
        for wanted in (None, run.name, "other", "../other", "none")
    ]
    assert names == [run.name, run.name, "other", run.name, run.name]
