"""A recording played back: on a bus as it was published, and as text."""

import json
import subprocess
import sys
import threading

import pytest

from laptop.cli import main
from sim.virtual.run import run_virtually
from swarm.bus.zenoh_bus import Bus
from swarm.messages import AppState, Links, LinkState, Pose, type_of
from swarm.messages.codec import decode
from swarm.recording.core.writer import Writer
from swarm.recording.restore import published
from swarm.recording.run import Run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    run_virtually("localization", "--robots", "2", "--iterations", "10", "--record", str(folder / "x"))
    return folder / "x"


def test_every_message_comes_back_as_one_of_its_key(recorded):
    """Nothing is missing and nothing is too much: a reader of the bus takes all of them."""
    import msgpack

    kinds = set()
    for sample in Run(recorded).samples():
        kind = type_of(sample.topic)
        if kind is not None:
            decode(kind, msgpack.packb(published(sample.topic, sample.message)), sample.topic)
            kinds.add(kind)
    assert {AppState, Pose, Links} <= kinds


def test_what_was_none_is_there_again(tmp_path):
    link = LinkState("r1", "down", 0, None, 0, 0, "no route")
    pose = Pose(1.0, 1, 0.5, 0.25, None, 90, "ekf")
    writer = Writer("test", epoch_ns=0)
    writer.write("swarm/r0/mesh/links", 1.0, Links(1.0, (link,)))
    writer.write("swarm/r0/dwm/pose", 1.0, pose)
    writer.write("swarm/r0/app/x/asked", 1.0, {"t": 1.0})
    (tmp_path / "x.mcap").write_bytes(b"".join(writer.finish()))
    found = {sample.topic: published(sample.topic, sample.message) for sample in Run(tmp_path / "x.mcap").samples()}
    assert found["swarm/r0/mesh/links"]["links"][0]["rtt"] is None
    assert found["swarm/r0/dwm/pose"].keys() == set(Pose.__slots__)
    assert found["swarm/r0/app/x/asked"] == {"t": 1.0}


@pytest.mark.parametrize(
    ("words", "what"), [(("foo/bar",), " under foo/bar"), (("--start", "1000"), " from 1000 s on")]
)
def test_a_replay_of_nothing_is_an_error(recorded, capsys, words, what):
    with pytest.raises(SystemExit) as ended:
        main(["replay", str(recorded), *words, "--json"])
    assert ended.value.code == 2
    assert f"the recording has no message{what}" in capsys.readouterr().err


def test_a_replay_prints_messages_as_json(recorded, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["replay", str(recorded), "swarm/r1/**/state", "--json"])
    assert ended.value.code == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    states = [line for line in lines if line["key"].endswith("localization/state")]
    assert [line["message"]["k"] for line in states] == list(range(11))
    assert [line["t"] for line in lines] == sorted(line["t"] for line in lines)


def test_on_a_bus_that_is_there(recorded, runtime, processes, router):
    seen, done = [], threading.Event()

    def take(key, payload):
        seen.append((key.split("/")[1], decode(AppState, payload, key).k))
        if len(seen) == 22:
            done.set()

    with Bus.of(runtime) as bus:
        bus.subscribe("swarm/*/app/*/state", take)
        assert bus.wait_connected(60)
        process = processes.start("-m", "laptop.cli", "replay", str(recorded), "--speed", "2", "--on", str(runtime))
        assert done.wait(60)
        assert process.wait(60) == 0
    assert [k for robot, k in seen if robot == "r1"] == list(range(11))


def test_on_a_bus_of_its_own_where_z_sub_looks(recorded, runtime, processes):
    process = processes.start("-m", "laptop.cli", "replay", str(recorded), "--speed", "50",
                              "--run-dir", str(runtime / "play"))  # fmt: skip
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out == f"{sum(1 for _ in Run(recorded).samples())} messages\n"
    assert f"playing on unixsock-stream/{runtime}/play/replay/bus.sock" in err


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf"])
def test_a_speed_is_above_zero(recorded, speed):
    command = [sys.executable, "-m", "laptop.cli", "replay", str(recorded), "--speed", speed]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "expected a number above 0" in done.stderr
