"""A board of simulated modules that works in a thread of its own, as in a simulation, and their config."""

import contextlib
import threading

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


@contextlib.contextmanager
def working(runtime, config, *robots, seed=1):
    """Modules for these robots, the anchors and the target, at work until the end of the block."""
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
