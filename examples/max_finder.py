"""Every robot finds the largest value of the swarm and who has it, in as many iterations as the graph is wide."""

from swarm import SyncApp


class MaxFinder(SyncApp):
    """Without a parameter `value`, each robot draws its own number from 0 to 1."""

    value: float = -1.0
    place: int

    def start(self):
        """Say who has the value, by its place in swarm.toml."""
        if self.value < 0:
            self.value = self.robot.random.random()
        self.place = self.robot.swarm.index(self.robot.name)

    def step(self, neighbours):
        """Keep the largest; of equal ones that of the first robot."""
        best = max([self, *neighbours], key=lambda seen: (seen.value, -seen.place))
        self.value, self.place = best.value, best.place

    def result(self):
        """Report the owner by name."""
        return {"value": self.value, "owner": self.robot.swarm[self.place]}
