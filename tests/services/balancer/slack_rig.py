"""Slack tasks in virtual time: ticks of a simulated robot whose bus takes its time."""

from balancer_rig import Rig

from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.slack.wire_time import Transfer, WireTime
from services.balancer.slack_tasks import SlackTasks
from sim.core.devices import SimulatedRobot

AT_100_KHZ = WireTime(100e3)


class Ticking:
    """A robot whose loop calls the slack tasks after each control step."""

    def __init__(self, rig: Rig | None = None) -> None:
        self.rig = rig or Rig()
        self.tasks = SlackTasks(self.rig.balancer, lambda: self.rig.now)
        self.news: list = []
        self.transfers: list[tuple[int, Transfer]] = []
        self.tick = 0
        driver = self.rig.balancer.balboa
        transfer = driver.transfer
        driver.transfer = lambda each: (self.transfers.append((self.tick, each)), transfer(each))[1]

    def run(self, seconds: float) -> "Ticking":
        for _ in range(round(seconds / PERIOD_S)):
            self.rig.run(PERIOD_S)
            self.tick += 1
            self.news += self.tasks.run(self.rig.deadline)
        return self

    def of(self, kind: type) -> list:
        return [each for each in self.news if isinstance(each, kind)]

    @property
    def robot(self) -> SimulatedRobot:
        return self.rig.robot
