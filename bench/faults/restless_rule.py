"""What the recordings of `restless.py` must hold, worked out once more from the rule alone, epoch by epoch.

An epoch is a stretch of the run with the same members and links. Within it every value follows from those at its first
iteration. A member begins it with its value of that iteration in the epoch before; who did not answer in time, or was
left out meanwhile, with the newest that it had; who has lost its state by a reboot with that of a start.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bench.faults.restless import swing
from swarm.core.graph import Graph
from swarm.recording.reader import RecordingReader
from swarm.recording.trajectory import beside, is_state

State = tuple[float, int]
"""Value, and steps done."""


@dataclass
class Epoch:
    """What one epoch was, and what was recorded in it."""

    counter: int
    first: int
    """Its first iteration."""
    graph: Graph
    began: dict[str, float] = field(default_factory=dict)
    """When each robot heard of it."""
    states: dict[str, dict[int, State]] = field(default_factory=dict)
    """By robot and iteration."""
    forks: list[str] = field(default_factory=list)
    """Iterations that a robot has recorded twice with different values."""


def read(paths: Mapping[str, Sequence[Path]], graph: Graph) -> dict[int, Epoch]:
    """All epochs by their number, in their order, from each robot's recordings; `graph` is that of the first one, whose
    number is 0 here."""
    epochs = {0: Epoch(0, 0, graph)}
    for robot, files in paths.items():
        number = 0
        for sample in (sample for path in files for sample in RecordingReader(path).samples()):
            message = sample.message
            if is_state(sample.topic):
                state = float(message["state"]["value"]), int(message["result"]["n"])
                states, k = epochs[number].states.setdefault(robot, {}), int(message["k"])
                if states.setdefault(k, state) != state:
                    epochs[number].forks.append(f"{robot} has {states[k]} and {state} at {k} of epoch {number}")
            elif sample.topic == beside(f"swarm/{robot}/app/restless/state")[0]:
                number = int(message["frames"])
                links = [(a, b) for a, b in message["links"]]
                found = Epoch(message["epoch"], message["k"], Graph(tuple(message["members"]), links))
                epochs.setdefault(number, found).began.setdefault(robot, sample.t)
    return dict(sorted(epochs.items(), key=lambda item: item[1].counter))


@dataclass
class Comparison:
    """What came of it."""

    compared: int = 0
    """Recorded values that there is something to compare with."""
    wrong: list[str] = field(default_factory=list)
    """Each that is another one, named."""
    anew: Counter[str] = field(default_factory=Counter)
    """How often each robot has begun a later epoch with the state of a start."""
    unknown: int = 0
    """Recorded values of which nothing could be said: their neighbours' were lost in a reboot."""


def compare(epochs: Mapping[int, Epoch], starts: Mapping[str, float]) -> Comparison:
    """Work all of it out again; `starts`: each robot's first value, whose place among them is its phase."""
    result = Comparison()
    before: dict[str, dict[int, State]] = {}
    newest: dict[str, State] = {}
    for epoch in epochs.values():
        result.wrong += epoch.forks
        known = {name: dict(epoch.states.get(name, {})) for name in epoch.graph.names}
        for name, states in known.items():
            if epoch.first in states:
                own = before.get(name, {}).get(epoch.first), newest.get(name)
                _begin(result, epoch, name, states[epoch.first], own, (starts[name], 0))
        newest.update({name: states[max(states)] for name, states in known.items() if states})
        _go_on(result, epoch, known, {name: float(index) for index, name in enumerate(starts)})
        before.update(known)
    return result


def _begin(
    result: Comparison, epoch: Epoch, name: str, begun: State, own: tuple[State | None, State | None], start: State
) -> None:
    """The state with which a robot goes into an epoch must be one of its own: that of its first iteration in the epoch
    before, or the newest that it has recorded."""
    if begun in own:
        result.compared += 1
    elif begun == start:
        result.compared += 1
        result.anew[name] += epoch.counter > 0
    else:
        result.wrong.append(f"{name} began epoch {epoch.counter} at {epoch.first} with {begun}")


def _go_on(result: Comparison, epoch: Epoch, known: dict[str, dict[int, State]], phases: Mapping[str, float]) -> None:
    """Compute each value of an epoch from those before, and put in what was not recorded."""
    weights = {name: epoch.graph.metropolis_weights(name) for name in epoch.graph.names}
    last = max((k for states in known.values() for k in states), default=-1)
    for k in range(epoch.first, last):
        for name in epoch.graph.names:
            expected = _step(name, {other: known[other].get(k) for other in known}, weights[name], phases[name])
            found = known[name].get(k + 1)
            if expected is None:
                result.unknown += found is not None
            elif found is None:
                known[name][k + 1] = expected
            elif found == expected:
                result.compared += 1
            else:
                result.wrong.append(f"{name} has {found} at {k + 1} of epoch {epoch.counter}, not {expected}")


def _step(name: str, at: Mapping[str, State | None], weights: Mapping[str, float], phase: float) -> State | None:
    """The rule, in another few lines than the app's; None where a value is not known."""
    own = at[name]
    if own is None or any(at[other] is None for other in weights):
        return None
    value, n = own
    pull = math.fsum(
        weights[other] * (theirs[0] - value) for other in sorted(weights) if (theirs := at[other]) is not None
    )
    return (value + pull) + swing(n, phase), n + 1


def lost(epochs: Mapping[int, Epoch]) -> int:
    """The most iterations in a row that a robot has computed, as its neighbours' values tell, and that its recording
    lacks."""
    longest = 0
    for epoch in epochs.values():
        for name in epoch.graph.names:
            mine = epoch.states.get(name, {})
            others = [k for other in epoch.graph.neighbours(name) for k in epoch.states.get(other, {})]
            run = 0
            for k in range(epoch.first, max([*mine, *(k - 1 for k in others)], default=-1) + 1):
                run = 0 if k in mine else run + 1
                longest = max(longest, run)
    return longest
