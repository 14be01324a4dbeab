"""`swarm export --table`: any topic, as CSV, npz, mat or parquet, on one time axis."""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from laptop.cli.runs import export, plot
from laptop.runs import tables
from laptop.runs.results import load
from sim.virtual.run import run_virtually
from swarm.errors import LocalError, RecordingError
from swarm.recording.run import Run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("run") / "run"
    run_virtually("led_sync", "--robots", "3", "--seconds", "4", "--clock-skew", "20ppm", "--record", str(place))
    return place


def exported(recorded: Path, *words: str) -> int:
    parser = argparse.ArgumentParser()
    export.add_arguments(parser)
    return export.run(parser.parse_args([str(recorded), *words]))


TOPICS = ("dwm/pose", "balancer/state", "mesh/links", "sim/leds")


def test_every_topic_is_a_table_on_the_runs_time_axis(recorded: Path, tmp_path: Path) -> None:
    wanted = [word for topic in TOPICS for word in ("--topic", topic)]
    assert exported(recorded, "--table", str(tmp_path), *wanted) == 0
    for topic in TOPICS:
        with (tmp_path / f"{topic.replace('/', '.')}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert {row["robot"] for row in rows} == {"r0", "r1", "r2"}
        times = [float(row["t"]) for row in rows]
        assert times == sorted(times)
        assert -1.0 < times[0] < 1.5  # clocks that began up to an hour apart
        assert times[-1] < 6.0
    with (tmp_path / "mesh.links.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert last["links.r1.state"] == "up"
    with (tmp_path / "balancer.state.csv").open() as file:
        assert {row["battery"] for row in csv.DictReader(file)} == {"7.4"}


def test_an_npz_table_holds_numbers_not_texts(recorded: Path, tmp_path: Path) -> None:
    assert exported(recorded, "--table", str(tmp_path), "--topic", "sim/truth", "--format", "npz") == 0
    table = np.load(tmp_path / "sim.truth.npz")
    assert table["x"].dtype == np.float64
    assert len(table["t"]) == len(table["x"]) == len(table["robot"]) > 40


@pytest.mark.parametrize(("kind", "needs"), [("mat", "scipy"), ("parquet", "pyarrow")])
def test_what_is_not_installed_is_named_before_anything_is_written(
    recorded: Path, tmp_path: Path, kind: str, needs: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, needs, None)
    with pytest.raises(LocalError, match=f'--format {kind} needs {needs}: pip install "balboa-swarm'):
        exported(recorded, "--csv", str(tmp_path / "a"), "--table", str(tmp_path / "b"), "--format", kind)
    assert list(tmp_path.iterdir()) == []


def test_a_state_that_is_called_t_takes_not_the_place_of_the_time(tmp_path: Path) -> None:
    (tmp_path / "clash.py").write_text(
        "from swarm import SyncApp\nclass Clash(SyncApp):\n    t: float = 7.0\n    iteration: int = 5\n"
        "    def step(self, neighbours):\n        self.iteration += 1\n"
    )
    run_virtually(str(tmp_path / "clash.py"), "--robots", "2", "--iterations", "3", "--record", str(tmp_path / "run"))
    assert exported(tmp_path / "run", "--table", str(tmp_path / "table")) == 0
    with (tmp_path / "table" / "r1.clash.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["t"]) < 1.0
    assert (last["app.t"], last["iteration"]) == ("7.0", "8")
    pytest.importorskip("pandas", reason="the notebook extra is not installed")
    table = load(tmp_path / "run").to_pandas()
    assert (table["iteration"].max(), table["app.iteration"].max(), table["app.t"].max()) == (3, 8, 7.0)


MATRIX = """
import numpy as np
from swarm import Array, SyncApp
class Matrix(SyncApp):
    P: Array[2, 2] = np.eye(2)
    def step(self, neighbours):
        self.P = self.mix("P")
    def result(self):
        return {"P": self.P, "trace": float(np.trace(self.P))}
"""


def test_a_matrix_has_one_name_for_each_entry_wherever_it_is_shown(tmp_path: Path) -> None:
    (tmp_path / "matrix.py").write_text(MATRIX)
    place, columns = tmp_path / "run", ["P[0,0]", "P[0,1]", "P[1,0]", "P[1,1]"]
    outcome = run_virtually(str(tmp_path / "matrix.py"), "--robots", "2", "--iterations", "3", "--record", str(place))[
        1
    ]
    named = (*columns, *(f"result.{name}" for name in columns), "result.trace")
    assert {path.columns for path in outcome.trajectories.values()} == {named}
    assert {path.columns for path in Run(place).trajectories().values()} == {named}
    assert exported(place, "--table", str(tmp_path)) == 0
    with (tmp_path / "r0.matrix.csv").open() as file:
        assert next(csv.reader(file)) == ["k", "t", *named]
    assert exported(place, "--table", str(tmp_path), "--topic", "app/matrix/state") == 0
    with (tmp_path / "app.matrix.state.csv").open() as file:
        assert next(csv.reader(file))[3:7] == [f"state.{name}" for name in columns]
    picture = tmp_path / "P.svg"
    parser = argparse.ArgumentParser()
    plot.add_arguments(parser)
    assert plot.run(parser.parse_args([str(place), "--column", "P[0,1]", "-o", str(picture)])) == 0
    assert ">P[0,1]<" in picture.read_text()
    assert set(load(place).columns) == {"P", "trace"}


TABLE = {"k": [0, 1], "x[0]": [0.5, None], "x_0": [1.0, 2.0], "2nd": [True, False], "name": ["a", None]}


def test_mat_files_are_read_by_scipy(tmp_path: Path) -> None:
    io = pytest.importorskip("scipy.io", reason="mat files need scipy, of the extra `tables`")
    tables.write(tmp_path / "a.mat", {**TABLE, "y" * 70: [1, 2], "y" * 71: [3, 4]})
    found = io.loadmat(tmp_path / "a.mat", squeeze_me=True)
    assert list(found["k"]) == [0, 1]
    assert found["x_0"][0] == 0.5
    assert np.isnan(found["x_0"][1])
    assert list(found["x_0_2"]) == [1.0, 2.0]
    assert list(found["x2nd"]) == [True, False]
    assert [text.strip() for text in found["name"]] == ["a", ""]
    assert [list(each) for name, each in found.items() if name.startswith("yyy")] == [[1, 2], [3, 4]]


def test_parquet_files_are_read_by_pyarrow(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="parquet files need pyarrow, of the extra `tables`")
    tables.write(tmp_path / "a.parquet", TABLE)
    found = parquet.read_table(tmp_path / "a.parquet").to_pydict()
    assert list(found) == list(TABLE)
    assert found["k"] == [0, 1]
    assert found["2nd"] == [True, False]
    assert found["name"] == ["a", ""]


def test_whole_numbers_keep_all_their_bits(tmp_path: Path) -> None:
    large = 4611686018427387916
    tables.write(tmp_path / "a.npz", {"k": [0, large], "some": [1, None], "odd": [2**64, 1]})
    found = np.load(tmp_path / "a.npz")
    assert found["k"].tolist() == [0, large]
    assert np.isnan(found["some"][1])
    assert found["odd"].dtype == float


def test_a_topic_that_is_none_is_named_with_those_that_are_there(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no topic sim/nothing is recorded; there are: .*sim/leds"):
        tables.of_topic(Run(recorded), "sim/nothing")
    tables.write(tmp_path / "a.csv", {"t": [0.0, 1.0], "text": ['a,"b"', None]})
    assert (tmp_path / "a.csv").read_text() == 't,text\n0.0,"a,""b"""\n1.0,\n'
    with pytest.raises(LocalError, match="it is there already"):
        tables.write(tmp_path / "a.csv", {"t": [0.0]})
