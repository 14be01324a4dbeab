"""One lockstep core, r0's, in a state that a test begins with, and frames of its neighbours."""

import dataclasses

from lockstep_world import RUN, SCHEMA

from swarm.core.lockstep.actions import Save, Send
from swarm.core.lockstep.frames import (
    Channel,
    encode_step,
)
from swarm.core.lockstep.lockstep import Lockstep

OURS = Channel(RUN, 0, 3, SCHEMA)
THEIRS = Channel(RUN, 0, 5, SCHEMA)


def core(neighbours=("r1",), *, size=2, **options):
    return Lockstep("r0", neighbours, OURS, size, **options)


def started(neighbours=("r1",), **options):
    one = core(neighbours, **options)
    one.start(b"a0", 0.0)
    one.actions()
    return one


def at(k, neighbours=("r1",), **options):
    """A core at iteration k that has used x(k-1) of all its neighbours and has nothing else of them."""
    one = started(neighbours, **options)
    for i in range(k):
        for name in neighbours:
            one.receive(name, THEIRS, step_of(i), 0.0)
        one.computed(b"a%d" % ((i + 1) % 10), b"", 0.0)
    one.actions()
    return one


def step_of(k):
    return encode_step(k, b"b%d" % (k % 10), b"b%d" % ((k - 1) % 10) if k else None)


def kinds(actions):
    return [type(action) for action in actions]


def wants(actions):
    return [(action.to, action.data) for action in actions if isinstance(action, Send) and not action.around]


def last_save(one, k):
    for i in range(one.k, k):
        one.receive("r1", THEIRS, step_of(i), 0.0)
        one.computed(b"a%d" % (i + 1), b"private %d" % (i + 1), 0.0)
    return [action.snapshot.encode() for action in one.actions() if isinstance(action, Save)][-1]


def resumed(saved, incarnation=4, **options):
    channel = dataclasses.replace(OURS, incarnation=incarnation)
    again = Lockstep("r0", ("r1",), channel, 2, **options)
    return again, again.resume(saved, 100.0)
