"""The fixture of the tests of a recording's file; test modules name this file in `pytest_plugins`."""

from collections import Counter

import pytest

from swarm.recording import file
from swarm.recording.file import RecordingFile


@pytest.fixture
def open_file(tmp_path, monkeypatch):
    """Files whose own thread writes nothing within a test: the test itself decides when they are written."""
    monkeypatch.setattr(file, "FLUSH_S", 3600.0)
    opened = []

    def open_(path=None, counters=None, **options):
        counters = Counter() if counters is None else counters
        it = RecordingFile(path or tmp_path / "x.mcap", counters, **{"append": False, "min_free": 0, **options})
        opened.append(it)
        return it

    yield open_
    for it in opened:
        it.close()
