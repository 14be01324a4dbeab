"""One robot calls, all others answer it: messages beyond the neighbours, besides the lockstep."""

from swarm import SyncApp


class RollCall(SyncApp):
    """The first robot floods a call; each other robot sends an answer back, over as many links as it takes."""

    reached: int = 0
    answers: int = 0
    _call: str = ""

    def step(self, neighbours):
        """Call once; answer each call; count the answers."""
        robot = self.robot
        # All robots have begun by this iteration, because each step waits for the neighbours' values.
        if robot.name == robot.swarm[0] and self.k == len(robot.swarm):
            self._call = robot.flood(b"who is there?").ticket
        for message in robot.messages():
            if message.flooded:
                robot.send(message.sender, b"me")
            else:
                self.answers += 1
        if (answer := robot.answer(self._call)) is not None:
            self.reached = len(answer.robots)
