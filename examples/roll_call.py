"""One robot calls, all others answer it: messages beyond the neighbours, besides the lockstep."""

from swarm import SyncApp


class RollCall(SyncApp):
    """The first robot floods a call; whoever hears it sends an answer back, over as many links as it takes."""

    reached: int = 0
    answers: int = 0
    _call: str = ""

    def step(self, neighbours):
        """Call once; answer whoever calls; count who answers."""
        robot = self.robot
        # By now all have begun, since each step waits for the neighbours' one.
        if robot.name == robot.swarm[0] and self.k == len(robot.swarm):
            self._call = robot.flood(b"who is there?").ticket
        for message in robot.messages():
            if message.flooded:
                robot.send(message.sender, b"me")
            else:
                self.answers += 1
        if (answer := robot.answer(self._call)) is not None:
            self.reached = len(answer.robots)
