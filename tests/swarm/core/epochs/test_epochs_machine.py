"""Changes of members against a hypothesis state machine: cuts, partitions, kills, reboots, returns, loss.

The world checks at each step that no epoch has two successors and that every state is the one of the model: the epochs
one after the other, each a plain synchronous run. In the end, mended, all robots are in one epoch and get on.
"""

import pytest
from epochs_world import World
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from swarm.core.epochs.actions import EpochRequest


@st.composite
def connected_graphs(draw):
    n = draw(st.integers(2, 6))
    edges = {(draw(st.integers(0, j - 1)), j) for j in range(1, n)}
    more = [(i, j) for i in range(n) for j in range(i + 1, n)]
    edges |= set(draw(st.lists(st.sampled_from(more), max_size=6)))
    return sorted((f"r{i}", f"r{j}") for i, j in edges)


picks = st.integers(0, 59)
pauses = st.sampled_from((0.0, 0.02, 0.05, 0.1, 0.3, 1.0, 2.5, 4.0, 8.0))
"""Virtual seconds that pass after something has happened; robots are given up after 2."""


class Swarm(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.world = None

    @initialize(
        edges=connected_graphs(),
        seed=st.integers(0, 2**16),
        compute=st.sampled_from((0.0, 0.02, 0.3)),
        starting=st.sampled_from((0.0, 0.3, 2.0)),
    )
    def begin(self, edges, seed, compute, starting):
        self.world = World(edges, seed=seed, last=2000)
        self.world.compute, self.world.latency, self.world.jitter = compute, 0.1, 0.03
        self.world.starting = starting
        for name in self.world.names:
            self.world.at(self.world.random.random(), lambda name=name: self.world.start(name))
        self.world.run(1.2)

    def robot(self, pick):
        return self.world.names[pick % len(self.world.names)]

    @rule(pick=picks, pause=pauses)
    def link_breaks(self, pick, pause):
        self.world.cut.add(self.world.edges[pick % len(self.world.edges)])
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def link_comes_back(self, pick, pause):
        self.world.cut.discard(self.world.edges[pick % len(self.world.edges)])
        self.world.run(pause)

    @rule(side=st.sets(picks, min_size=1, max_size=3), pause=pauses)
    def swarm_falls_apart(self, side, pause):
        here = {self.robot(pick) for pick in side}
        self.world.cut |= {edge for edge in self.world.edges if len(here.intersection(edge)) == 1}
        self.world.run(pause)

    @rule(pause=pauses)
    def all_links_come_back(self, pause):
        self.world.cut.clear()
        self.world.run(pause)

    @rule(loss=st.sampled_from((0.0, 0.1, 0.5)), pause=pauses)
    def weather_changes(self, loss, pause):
        self.world.loss = loss
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def is_killed(self, pick, pause):
        self.world.kill(self.robot(pick))
        self.world.run(pause)

    @rule(pick=picks, actions=st.integers(0, 12), pause=pauses)
    def is_killed_between_two_actions(self, pick, actions, pause):
        process = self.world.processes.get(self.robot(pick))
        if process is not None:
            process.dies_after = actions
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def reboots(self, pick, pause):
        self.world.reboot(self.robot(pick))
        self.world.start(self.robot(pick))
        self.world.run(pause)

    @rule(pick=picks, reboots=st.booleans(), pause=pauses)
    def finds_its_votes_damaged(self, pick, reboots, pause):
        robot = self.robot(pick)
        self.world.damage(robot)
        if reboots:
            self.world.reboot(robot)
            self.world.births[robot] = 0  # the count of its processes is in the runtime directory
        self.world.start(robot)
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def comes_back(self, pick, pause):
        self.world.start(self.robot(pick))
        self.world.run(pause)

    @rule(pick=picks, pause=pauses)
    def operator_renews(self, pick, pause):
        process = self.world.processes.get(self.robot(pick))
        if process is not None:
            process.take(lambda process: process.lockstep.request(EpochRequest(), self.world.now))
        self.world.run(pause)

    def teardown(self):
        if self.world is None:
            return
        self.world.heal()
        if not self.gets_on() and any(process.lockstep.epochs.lost for process in self.world.processes.values()):
            # Too few robots have their vote: the operator answers for the next epoch.
            members = [process for process in self.world.processes.values() if process.lockstep.epochs.member]
            newest = max(members, key=lambda process: process.lockstep.epochs.epoch.counter)
            newest.take(lambda process: process.lockstep.request(EpochRequest(force=True), self.world.now))
        assert self.gets_on()

    def gets_on(self):
        """Whether all robots come together, and are done or move."""
        if not self.world.run(60.0, until=self.world.together):
            return False
        done = all(process.lockstep.k == 2000 for process in self.world.processes.values())
        return done or self.world.moving()


EXAMPLES = settings(
    max_examples=5,
    stateful_step_count=15,
    deadline=None,
    print_blob=True,
    phases=[phase for phase in Phase if phase != Phase.explain],
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)


def test_whatever_happens_to_the_members():
    run_state_machine_as_test(Swarm, settings=EXAMPLES)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_whatever_happens_to_the_members_in_many_examples():
    run_state_machine_as_test(Swarm, settings=settings(EXAMPLES, max_examples=70, stateful_step_count=40))
