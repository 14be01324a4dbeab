"""The files that `swarm new` writes: a commented app of each kind that does something, and its test."""

SYNC = '''"""@NAME@: say here what it does. `swarm check @FILE@`, then `swarm sim @FILE@ --robots 6`."""

from math import fsum

from swarm import SyncApp, parameter


class @CLASS@(SyncApp):
    """Every robot ends on the mean of the first values."""

    # Shared state: sent to the neighbours after each step. Types: float, float32, int, bool, Array[n] of numpy.
    # Without a value here it starts at zero; `--set r2.value=3` or swarm.toml give another one.
    value: float

    # Private state has a leading underscore: never sent, saved for a restart.
    _moved: float = 0.0

    # Settings, from swarm.toml or `--set gain=0.5`; a step cannot change them.
    gain: float = parameter(1.0, unit="1", low=0, high=1)

    # def start(self):
    #     """Set the first state, once; self.robot has name, neighbours, swarm, anchors, random, log..."""

    def step(self, neighbours):
        """Turn state k into state k + 1. `neighbours`: those of self.robot, sorted by name, with their states k.

        Keep it pure: no clock, no files, no random numbers but self.robot.random. Then every run repeats.
        """
        # weighted() pairs each neighbour with its Metropolis weight; with these the mean of all values stays.
        # fsum, not sum: that one rounds floats differently from Python 3.12 on, and robots may have another one.
        self._moved = self.gain * fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))
        self.value += self._moved

    def result(self):
        """What the run reports, always under the same names; without this method it is the shared state."""
        return {"value": self.value, "moved": self._moved}
'''

SYNC_TEST = '''"""Test of @FILE@: all robots in one process, no links, no waiting. Run it with pytest."""

from pathlib import Path

import pytest

from swarm import rehearse

APP = Path(__file__).with_name("@FILE@")


@pytest.mark.parametrize("topology", ["line", "loop", "thesis-d", "full"])
def test_all_robots_end_on_the_mean(topology):
    starts = {f"r{i}": {"value": float(i)} for i in range(6)}
    swarm = rehearse(APP, robots=6, topology=topology, values=starts)
    swarm.run(300)  # iterations
    for name in starts:
        assert swarm.result(name)["value"] == pytest.approx(2.5, abs=1e-6)


def test_one_step_on_a_line_of_two():
    swarm = rehearse(APP, robots=2, values={"r0": {"value": 0.0}, "r1": {"value": 4.0}})
    swarm.run(1)
    assert swarm.result("r0")["value"] == 2.0
'''

PERIODIC = '''"""@NAME@: say here what it does. `swarm check @FILE@`, then `swarm sim @FILE@ --set r0.first=true`."""

from swarm import PeriodicApp, parameter


class @CLASS@(PeriodicApp):
    """A light goes through the swarm: who sees a neighbour alight lights up, too."""

    # Shared state: goes to the neighbours whenever it has changed. Nobody waits for anybody.
    lit: bool

    # s between two steps; each robot may have its own: `--set r1.period=0.5`.
    period = 0.2

    # Settings; of an app like this they may be changed while it runs: `swarm app param @NAME@ first=true`.
    first: bool = parameter(False)

    def step(self, neighbours):
        """Called every period. `neighbours`: their newest states, sorted by name, each with its `age` in s."""
        if self.first or any(n.lit for n in neighbours):
            self.lit = True
        self.robot.leds(green=self.lit)

    def on_button(self, button):
        """Button "a", "b" or "c" of this robot was pressed. More handlers: docs/how-to/apps/react-to-events.md."""
        self.lit = True
'''

PERIODIC_TEST = '''"""Test of @FILE@: all robots in one process, in virtual time. Run it with pytest."""

from pathlib import Path

from swarm import rehearse

APP = Path(__file__).with_name("@FILE@")


def test_the_light_goes_through_the_swarm():
    swarm = rehearse(APP, robots=4, topology="line", values={"r0": {"first": True}})
    swarm.run(3.0)  # until this time, s
    assert all(swarm.result(name)["lit"] for name in swarm.units)


def test_it_stays_dark_until_a_button_is_pressed():
    swarm = rehearse(APP, robots=4, topology="line")
    swarm.run(3.0)
    assert not any(swarm.result(name)["lit"] for name in swarm.units)
    swarm.units["r2"].press("a")
    swarm.run(6.0)
    assert all(swarm.result(name)["lit"] for name in swarm.units)
'''

EVENT = '''"""@NAME@: say here what it does.

Try it: `swarm check @FILE@`, then `swarm sim @FILE@`, and `swarm hand press r1 A`.
"""

from swarm import EventApp


class @CLASS@(EventApp):
    """Count the button presses of the whole swarm."""

    # Shared state: goes to the neighbours whenever it has changed; `result` reports it. May be left out.
    presses: int

    # Handlers run one at a time, and none waits for anything. More of them: docs/how-to/apps/react-to-events.md.

    def on_button(self, button):
        """Button "a", "b" or "c" of this robot was pressed: tell the whole swarm."""
        self.presses += 1
        self.robot.flood(button.encode())

    def on_message(self, message):
        """The same app on another robot has flooded something: `message.sender`, `message.payload`."""
        self.presses += 1
        self.robot.display(f"{self.presses} presses", f"last: {message.payload.decode()} on {message.sender}")
'''

EVENT_TEST = '''"""Test of @FILE@: all robots in one process, in virtual time. Run it with pytest."""

from pathlib import Path

from swarm import rehearse

APP = Path(__file__).with_name("@FILE@")


def test_every_robot_counts_every_press():
    swarm = rehearse(APP, robots=3, topology="line")
    swarm.run(1.0)  # until this time, s
    swarm.units["r1"].press("b")
    swarm.run(2.0)
    swarm.units["r2"].press("a")
    swarm.run(3.0)
    assert [swarm.result(name)["presses"] for name in swarm.units] == [2, 2, 2]
'''

KINDS = {"sync": (SYNC, SYNC_TEST), "periodic": (PERIODIC, PERIODIC_TEST), "event": (EVENT, EVENT_TEST)}
"""By kind: the app and its test, with @NAME@, @FILE@ and @CLASS@ to be filled in."""


def fill(text: str, name: str) -> str:
    """Return a template filled for the app of this name."""
    words = name.replace("-", "_").split("_")
    kind = "".join(word.capitalize() for word in words if word)
    return text.replace("@NAME@", name).replace("@FILE@", f"{name}.py").replace("@CLASS@", kind)
