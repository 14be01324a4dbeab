"""The lockstep rules against a hypothesis state machine: whatever happens, the trajectory is the undisturbed one."""

from functools import partial

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from lockstep_world import RUN, SCHEMA, STATE, World

from swarm.core.lockstep.frames import Channel, encode_step, encode_want

RECOVERY = 2.5
"""Virtual seconds in which a healed swarm has asked for all it lacks: the 1 s between two questions, and the way."""


@st.composite
def connected_graphs(draw):
    n = draw(st.integers(2, 5))
    edges = {(draw(st.integers(0, j - 1)), j) for j in range(1, n)}
    more = [(i, j) for i in range(n) for j in range(i + 1, n)]
    edges |= set(draw(st.lists(st.sampled_from(more), max_size=4)))
    return sorted((f"r{i}", f"r{j}") for i, j in edges)


picks = st.integers(0, 59)
"""A choice out of a list whose length is not known yet; divides by all lengths up to six."""
pauses = st.sampled_from((0.0, 0.005, 0.03, 0.04, 0.05, 0.07, 0.1, 0.3, 1.0, 3.0))
"""Virtual seconds that pass after something has happened; an iteration takes some 0.04."""


class Swarm(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.world = None
        self.doubled = set()
        self.forgot = set()

    @initialize(
        edges=connected_graphs(),
        last=st.sampled_from((1, 2, 3, 20, 100, 300)),
        seed=st.integers(0, 2**16),
        latency=st.sampled_from((0.0, 0.03)),
        compute=st.sampled_from((0.0, 0.01, 0.2)),
        stagger=st.sampled_from((0.0, 0.1, 2.0)),
    )
    def begin(self, edges, last, seed, latency, compute, stagger):
        self.world = World(edges, last, seed=seed, latency=latency, jitter=latency / 2)
        self.world.compute = compute
        self.world.on_fault = self.on_fault
        for robot in self.world.processes:
            self.world.at(stagger * self.world.random.random(), lambda robot=robot: self.start(robot))

    def start(self, robot):
        if not self.world.processes[robot]:
            self.world.start(robot)

    def on_fault(self, process, reason):
        """Only what was put in may come out: two processes of one robot, or a lost snapshot."""
        told = any(reason.startswith(f"state lost at {robot}:") for robot in self.doubled | self.forgot)
        second = reason.startswith(f"another process runs this app on {process.robot}")
        assert told or (second and process.robot in self.doubled), f"{process.robot}: {reason}"

    def robot(self, pick):
        return sorted(self.world.processes)[pick % len(self.world.processes)]

    def link(self, pick):
        return self.world.edges[pick % len(self.world.edges)]

    def some(self, pick):
        """One running process, or none."""
        return [self.world.running()[pick % len(self.world.running())]] if self.world.running() else []

    # Network

    @rule(loss=st.sampled_from((0.0, 0.05, 0.3, 0.9)), copies=st.sampled_from((0.0, 0.3, 1.0)), pause=pauses)
    def weather_changes(self, loss, copies, pause):
        self.world.loss, self.world.copies = loss, copies
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def link_breaks(self, pick, pause):
        self.world.cut_link(self.link(pick))
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def link_is_made_anew(self, pick, pause):
        self.world.mend_link(self.link(pick))
        self.world.run(pause)

    # Processes

    @rule(pick=picks, actions=st.integers(0, 12), down=pauses, pause=pauses)
    def is_killed_between_two_actions(self, pick, actions, down, pause):
        for process in self.some(pick):
            process.dies_after, process.then = actions, partial(self.back_after, process.robot, down)
        self.world.run(pause)

    @rule(pick=picks, down=pauses, pause=pauses)
    def is_killed(self, pick, down, pause):
        for process in self.some(pick):
            process.die()
            self.back_after(process.robot, down)
        self.world.run(pause)

    def back_after(self, robot, seconds):
        self.world.at(self.world.now + seconds, lambda: self.start(robot))

    @rule(pick=picks, pause=pauses)
    def is_stopped(self, pick, pause):
        for process in self.some(pick):
            process.stopped = True
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def continues(self, pick, pause):
        for process in self.some(pick):
            process.go_on()
        self.world.run(pause)

    @rule(pick=picks, hears=st.booleans(), pause=pauses)
    def starts_twice(self, pick, hears, pause):
        """A second process of one robot from the same file: the lock file is gone, the fence is all there is."""
        robot = self.robot(pick)
        if len(self.world.processes[robot]) == 1:
            self.doubled.add(robot)
            self.world.hears_itself = hears
            self.world.start(robot)
        self.world.run(pause)

    @rule(pick=picks, counter_too=st.booleans(), rare=st.integers(0, 20), pause=pauses)
    def loses_its_disk(self, pick, counter_too, rare, pause):
        robot = self.robot(pick)
        # Rare: it ends most of what an example could still show.
        if rare == 13 and not self.forgot and robot in self.world.disk:
            self.forgot.add(robot)
            self.world.kill(robot)
            del self.world.disk[robot]
            if counter_too:
                self.world.incarnations[robot] = 0
            self.world.start(robot)
        self.world.run(pause)

    # Strangers

    @rule(
        pick=picks,
        ahead=st.integers(-2, 2),
        ask=st.booleans(),
        what=st.sampled_from(("run", "epoch", "sender", "bytes")),
    )
    def a_stranger_speaks(self, pick, ahead, ask, what):
        for process in self.some(pick):
            peers = sorted(self.world.neighbours[process.robot])
            sender = "r9" if what == "sender" else peers[pick % len(peers)]
            k, wrong = max(0, process.core.k + ahead), STATE.pack(-1.0)
            data = encode_want(k) if ask else encode_step(k, wrong, wrong if k else None)
            channel = Channel(RUN + (what == "run"), int(what == "epoch"), 7, SCHEMA)
            process.receive(sender, channel.text, data + b"!" if what == "bytes" else data)

    # What must hold

    @invariant()
    def memory_is_bounded(self):
        if self.world:
            self.world.check_bounds()

    def teardown(self):
        """Mended, every swarm comes to its end: both sides waiting always resolves."""
        if self.world is None:
            return
        world = self.world
        for robot in self.doubled:
            # What the operator does: leave the newest process, start one where that has ended.
            for process in list(world.processes[robot]):
                if process.incarnation < world.incarnations[robot] - 1:
                    process.die()
        world.heal()
        bound = RECOVERY + (world.last + 1) * (2 * world.latency + world.compute + 0.001)
        reached = world.run(bound, until=world.finished)
        world.check_bounds()
        told = any(reason.startswith("state lost at") for reason in world.faults)
        if not reached and not told:
            # A robot that lost its file and its incarnation with it, early on, speaks in one that is ignored, and
            # its neighbours are not far enough ahead to tell it. Then who waits names whom it waits for.
            world.run(3.0)
            waits = [(process.robot, peers) for process in world.running() for _, _, peers in process.waits[-1:]]
            assert any(self.forgot & {robot, *peers} for robot, peers in waits if peers), f"stuck at {world.reached}"


EXAMPLES = settings(
    max_examples=10,
    stateful_step_count=30,
    deadline=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)


def test_whatever_happens_the_trajectory_is_the_undisturbed_one():
    run_state_machine_as_test(Swarm, settings=EXAMPLES)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_whatever_happens_in_many_examples():
    run_state_machine_as_test(Swarm, settings=settings(EXAMPLES, max_examples=500, stateful_step_count=60))
