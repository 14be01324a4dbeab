"""The fixture of the tests of a recording's file; test modules name this file in `pytest_plugins`."""

from collections import Counter

import pytest

from swarm.recording import file
from swarm.recording.file import RecordingFile

NEVER_S = 3600.0


@pytest.fixture
def open_file(tmp_path, monkeypatch):
    """Files whose own thread does not write within a test: what is written when is the test's to say."""
    monkeypatch.setattr(file, "FLUSH_S", NEVER_S)
    opened = []

    def open_(path=None, counters=None, **options):
        counters = Counter() if counters is None else counters
        it = RecordingFile(path or tmp_path / "x.mcap", counters, **{"append": False, "min_free": 0, **options})
        opened.append(it)
        return it

    yield open_
    for it in opened:
        it.close()
