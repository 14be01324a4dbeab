"""A board of simulated modules that works in a thread of its own, as in a simulation, and their config."""

import contextlib
import threading
from functools import partial
from unittest import mock

from sim.core import uwb
from sim.devices.module import ModuleBoard

ANCHORS = """
[[anchors]]
address = "D001"
x = 0.0
y = 0.0
[[anchors]]
address = "D002"
x = 1.94
y = 0.0
[[anchors]]
address = "D003"
x = 1.0
y = 1.94
"""
DWM = """
[dwm]
source = "serial:{directory}/{{robot}}/dwm.tty"
target = "C933"
distance = {{ gain = 0.946976, offset = -0.05964849 }}
[simulation]
target = [0.5, 1.0]
[simulation.places]
r0 = [0.5, 1.5, 0.0]
"""


CALM = partial(uwb.ErrorModel, noise=0.02, hidden=0.0, outlier=0.0, missing=0.0)
"""Half the noise, no wild errors, nothing missing: which of the seeded measurements a test sees is a matter of time.
One range in a hundred is off by half a metre else, and how many make a mean depends on how busy the machine is."""


@contextlib.contextmanager
def working(runtime, config, *robots, seed=1):
    """Modules for these robots, the anchors and the target, at work until the end of the block; they err as `CALM`."""
    with mock.patch.object(uwb, "ErrorModel", CALM):
        board = ModuleBoard(runtime, config, seed)
        for robot in robots:
            board.add(robot)
    ending = threading.Event()

    def work():
        while not ending.is_set():
            board.poll(0.02)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield board
    finally:
        ending.set()
        thread.join()
        board.close()
