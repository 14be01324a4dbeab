"""Finding apps, and what is said of files that are none; the examples are found and run here, too."""

import math
import re
from pathlib import Path
from typing import TypeVar

import pytest
from localization_rig import exact, noisy
from memory_swarm import TARGET, MemorySwarm, config_of

from services.apps import loader
from sim.rehearsal import EventRehearsal, rehearse
from sim.virtual.bus import VirtualBus
from swarm.errors import AppError
from swarm.messages import SetDisplay, SetLeds
from swarm.messages.codec import decode

M = TypeVar("M")
EXAMPLES = Path(__file__).parents[3] / "examples"


def write(directory: Path, text: str, name: str = "my_app.py") -> str:
    path = directory / name
    path.write_text(text)
    return str(path)


APP = (
    "from swarm import SyncApp\nclass Mine(SyncApp):\n    value: float\n    def step(self, neighbours):\n        pass\n"
)


def test_built_in_apps_are_found_with_their_algorithms() -> None:
    consensus, localization = loader.load("consensus").algorithms, loader.load("localization").algorithms
    assert list(consensus) == ["metropolis", "thesis", "second_order", "chebyshev", "flood"]
    assert list(localization) == ["info", "nids", "flood", "diging", "thesis", "moving"]


def test_a_file_is_an_app_named_as_the_file(tmp_path: Path) -> None:
    app = loader.load(write(tmp_path, APP))
    assert app.name == "my_app"
    assert app.choose({"value": 1.0})[0].__name__ == "Mine"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import nothing_of_that_name\n", r"my_app.py, line 1: ModuleNotFoundError: No module named"),
        ("x = 1\n\ny = x +\n", r"my_app.py, line 3: SyntaxError: invalid syntax"),
        ("\n1 / 0\n", r"my_app.py, line 2: ZeroDivisionError"),
        ("import sys\nsys.exit('bye')\n", r"my_app.py, line 2: SystemExit: bye"),
        ("def f():\n    raise ValueError('deep')\nf()\n", r"my_app.py, line 2: ValueError: deep"),
        ("x = 1\n", r"my_app.py defines no app: expected one class derived from SyncApp"),
        ("from swarm import SyncApp\n", r"defines no app"),
        (APP + APP.replace("Mine", "Yours"), r"defines several apps: Mine, Yours\. Leave one in it, or name them"),
        *(
            (
                f"{APP}ALGORITHMS = {wrong}\n",
                r"my_app\.py: ALGORITHMS: expected the classes of apps \(.*\) by name, the default first, as "
                rf"ALGORITHMS = {{\"name\": Class, \.\.\.}}; got {shown}",
            )
            for wrong, shown in (
                ("[Mine]", r"\[<class '.*Mine'>\]"),
                ("{'one': Mine, 'two': 2}", ".*'two': 2}"),
                ("{'one': int}", "{'one': <class 'int'>}"),
                ("{1: Mine}", "{1: .*}"),
                ("{'': Mine}", "{'': .*}"),
                ("{}", "{}"),
                ("None", "None"),
            )
        ),
        (APP.replace("float", "list"), r"my_app.py, line 2: class Mine: value: a shared field is of type"),
        (APP.replace("float", "'flaot'"), r"my_app.py, line 2: class Mine: an annotation cannot be read: name 'flaot'"),
    ],
)
def test_files_that_are_no_app_are_one_message_with_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(AppError, match=message) as caught:
        loader.load(write(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_names_that_are_no_app(tmp_path: Path) -> None:
    with pytest.raises(AppError, match=r"no app 'consensu': expected consensus, .*, unicast_demo, or a file FILE\.py"):
        loader.load("consensu")
    with pytest.raises(AppError, match="no such file"):
        loader.load(str(tmp_path / "none.py"))
    with pytest.raises(AppError, match="the file's name is the app's name on the bus"):
        loader.load(write(tmp_path, APP, "My App.py"))


def test_several_apps_may_be_algorithms_of_one(tmp_path: Path) -> None:
    names = 'ALGORITHMS = {"one": Mine, "two": Yours}\n'
    app = loader.load(write(tmp_path, APP + APP.replace("Mine", "Yours") + names))
    assert app.choose({})[0].__name__ == "Mine"
    assert app.choose({"algorithm": "two"})[0].__name__ == "Yours"
    with pytest.raises(AppError, match="algorithm: expected 'one' or 'two', got 'three'"):
        app.choose({"algorithm": "three"})


def test_a_helper_module_beside_the_file_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))  # undone after the test
    write(tmp_path, "START = 4.0\n", "helper_of_my_app.py")
    app = loader.load(write(tmp_path, "from helper_of_my_app import START\n" + APP.replace("float", "float = START")))
    assert app.make(config_of(2, app="my_app"), "r0").value == 4.0


def test_a_relative_import_is_refused_with_the_way_to_import_a_module_beside_the_file(tmp_path: Path) -> None:
    with pytest.raises(AppError, match=r"line 1: ImportError: .*; a module beside the app's file is"):
        loader.load(write(tmp_path, "from .helper import START\n" + APP))


def test_the_digest_is_of_the_source(tmp_path: Path) -> None:
    one = loader.load(write(tmp_path, APP)).digest
    assert loader.load(write(tmp_path, APP)).digest == one
    assert loader.load(write(tmp_path, APP + "\n")).digest != one


def test_wrong_parameters_name_app_and_robot() -> None:
    app = loader.load("consensus")
    config = config_of(3, parameters={}, robots={"r2": {"valeu": 1.0}})
    with pytest.raises(AppError, match="app consensus on r2: unknown parameter 'valeu'; Consensus has weights"):
        app.check(config)
    with pytest.raises(AppError, match=r"app consensus on r0: algorithm: expected 'metropolis' or .* got 'best'"):
        app.check(config_of(3, parameters={"algorithm": "best"}))
    with pytest.raises(AppError, match="app consensus: r1 runs another algorithm than r0"):
        app.check(config_of(3, robots={"r1": {"algorithm": "thesis"}}))


def test_a_class_that_is_a_channel_of_another_is_no_app_by_itself(tmp_path: Path) -> None:
    text = APP + "from swarm import PeriodicApp, channel\nclass Outer(PeriodicApp):\n    inner = channel(Mine)\n"
    assert loader.load(write(tmp_path, text)).algorithms[""].__name__ == "Outer"


# The examples


def test_every_example_is_short_and_tested_here() -> None:
    """But for roll_call.py, which needs meshes: tests/services/mesh/processes/test_mesh_apps.py."""
    files = {path.name: path.read_text() for path in EXAMPLES.glob("*.py")}
    synchronous = {"consensus.py", "max_finder.py", "find_target.py", "roll_call.py"}
    assert set(files) == {*synchronous, "button_count.py", "follow_leds.py"}
    assert all(len(text.splitlines()) <= 40 for text in files.values())


def test_the_example_consensus_agrees_on_the_mean() -> None:
    values = {f"r{i}": {"value": x} for i, x in enumerate((0.5, 3.0, 5.0))}
    swarm = MemorySwarm(str(EXAMPLES / "consensus.py"), config_of(3, robots=values), 100)
    assert all(result["value"] == pytest.approx(8.5 / 3) for result in swarm.final.values())


def test_the_example_max_finder_takes_as_many_iterations_as_the_diameter() -> None:
    """As many iterations as the graph is wide, and not one more."""
    values = {f"r{i}": {"value": float(i)} for i in range(6)}
    swarm = MemorySwarm(str(EXAMPLES / "max_finder.py"), config_of(6, app="max_finder", robots=values), 5)
    assert all(result == {"value": 5.0, "owner": "r5"} for result in swarm.final.values())
    assert swarm.results["r0"][4]["owner"] == "r4"
    drawn = MemorySwarm(str(EXAMPLES / "max_finder.py"), config_of(6, app="max_finder"), 5)
    assert len({results[0]["value"] for results in drawn.results.values()}) == 6
    assert len({tuple(result.items()) for result in drawn.final.values()}) == 1


@pytest.mark.parametrize(("measure", "within"), [(exact, 0.005), (noisy, 0.1)])
def test_the_example_find_target_finds_the_target(measure: object, within: float) -> None:
    app = str(EXAMPLES / "find_target.py")
    swarm = MemorySwarm(app, config_of(3, app="find_target"), 150, measure)
    for result in swarm.final.values():
        assert math.dist((result["x"], result["y"]), TARGET) < within


def commands(swarm: EventRehearsal, what: str, kind: type[M]) -> dict[str, list[tuple[float, M]]]:
    """What an app tells each robot's balancer to do, with the times; it fills up while the swarm runs."""
    found: dict[str, list[tuple[float, M]]] = {name: [] for name in swarm.units}
    for name, messages in found.items():
        VirtualBus(swarm.world.robots[name].router).subscribe(
            f"swarm/{name}/balancer/set/{what}",
            lambda key, payload, messages=messages: messages.append((swarm.world.time.now, decode(kind, payload, key))),
        )
    return found


def test_the_example_button_count_counts_presses_of_all_robots() -> None:
    swarm = rehearse(EXAMPLES / "button_count.py", robots=3)
    assert isinstance(swarm, EventRehearsal)
    shown = commands(swarm, "display", SetDisplay)
    swarm.run(1.0)
    swarm.units["r1"].press("b")
    swarm.run(2.0)
    swarm.units["r2"].press("a")
    swarm.run(3.0)
    for name, unit in swarm.units.items():
        assert unit.app.presses == 2
        assert "2 presses\nlast: a on r2" in [message.text for _, message in shown[name]]


def test_the_example_follow_leds_lights_robots_in_turn() -> None:
    swarm = rehearse(EXAMPLES / "follow_leds.py", robots=4, values={"r0": {"first": True}})
    assert isinstance(swarm, EventRehearsal)
    shown = commands(swarm, "leds", SetLeds)
    swarm.run(10.0)
    lit = {}
    for name, unit in swarm.units.items():
        assert unit.host.progress.phase == "running"
        lit[name] = next(time for time, leds in shown[name] if leds.green)
    assert lit["r0"] < lit["r1"] < lit["r2"] < lit["r3"] < 3.0


# The documentation


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        "docs/index.md",
        "docs/reference/apps.md",
        "docs/how-to/apps/react-to-events.md",
        "docs/how-to/apps/use-arrays.md",
        "docs/how-to/apps/talk-beyond-neighbours.md",
    ],
)
def test_the_apps_of_the_documentation_are_apps(tmp_path: Path, page: str) -> None:
    text = (EXAMPLES.parent / page).read_text()
    blocks = [block for block in re.findall(r"```python[^\n]*\n(.*?)```", text, flags=re.DOTALL) if "class " in block]
    assert blocks
    for number, block in enumerate(blocks):
        lines = block if "import" in block else f"from swarm import SyncApp\n{block}"
        name = f"page{number}"
        swarm = rehearse(write(tmp_path, lines, f"{name}.py"), robots=3)
        swarm.run(10)
        if isinstance(swarm, EventRehearsal):
            assert [unit.fault for unit in swarm.units.values()] == ["", "", ""]
