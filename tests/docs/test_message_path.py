"""The way of one value, from a robot's `step` to its neighbour's, is short, and a page of the docs tells it."""

import struct
import sys
from functools import partial
from pathlib import Path
from types import FrameType

from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun

ROOT = Path(sys.modules["sim.virtual.run"].__file__ or "").parents[2]
MOST_FILES = 18
MOST_FUNCTIONS = 40
"""Of `swarm` and `services`: what stands for Zenoh, radio and threads under virtual time is not on the way of a
robot's value."""
STAND_IN = "services/mesh/links/radio_model.py"
"""The radio of links that are simulated."""
HOLDERS = ("Compute", "Send", "Save", "Advanced", "Received", "QueuedMessage")
"""Classes that carry the value from one function to the next."""


class Tracer:
    """Notes each function that is given a value's bytes, or gives them, between two steps."""

    def __init__(self) -> None:
        self.needle = b""
        self.on = False
        self.found: dict[tuple[str, str], None] = {}

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if code.co_name == "step" and code.co_filename.endswith("consensus.py"):
            app = frame.f_locals["self"]
            if event == "return" and (app.robot.name, app.k) == ("r0", 5):
                self.needle, self.on = struct.pack("<d", app.value), True
            elif event == "call" and (app.robot.name, app.k) == ("r1", 6):
                self.on = False
        if not self.on or event not in ("call", "return") or "<" in code.co_name:
            return
        path = Path(code.co_filename)
        if not path.is_relative_to(ROOT) or path.relative_to(ROOT).parts[0] not in ("swarm", "services"):
            return
        if path == ROOT / STAND_IN:
            return
        if event == "call":
            names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
            seen = self.holds([frame.f_locals.get(name) for name in names])
        else:
            seen = self.holds(argument)
        if seen:
            self.found[str(path.relative_to(ROOT)), code.co_qualname] = None

    def holds(self, value: object, depth: int = 4) -> bool:
        """Whether the value's bytes are in here."""
        if isinstance(value, bytes | bytearray | memoryview):
            return self.needle in bytes(value)
        if depth == 0:
            return False
        if isinstance(value, dict):
            return any(self.holds(each, depth - 1) for each in value.values())
        if isinstance(value, tuple | list):
            return any(self.holds(each, depth - 1) for each in value)
        if isinstance(value, partial):
            return self.holds(value.args, depth - 1)
        if type(value).__name__ in HOLDERS:
            names = getattr(value, "__slots__", None) or vars(value)
            return any(self.holds(getattr(value, name, None), depth - 1) for name in names)
        return False


def test_a_value_passes_few_files_and_functions_on_its_way_to_the_neighbours_step() -> None:
    options = parse(["consensus", "--robots", "2", "--iterations", "8", "--virtual", "--mesh", "settled"])
    run = VirtualRun(options, build(options, PLACE))
    tracer = Tracer()
    sys.setprofile(tracer)
    try:
        run.go()
    finally:
        sys.setprofile(None)
    files = {file for file, _ in tracer.found}
    told = "\n".join(f"{file} {function}" for file, function in tracer.found)
    assert ("services/apps/runner.py", "Runner.step") in tracer.found, told
    assert ("services/mesh/core/wire/frames.py", "encode_data") in tracer.found, told
    assert len(files) <= MOST_FILES, told
    assert len(tracer.found) <= MOST_FUNCTIONS, told
    page = (ROOT / "docs/explanation/message-path.md").read_text()
    missing = [file for file in files if file not in page]
    assert not missing, f"docs/explanation/message-path.md: it does not name {missing}"
