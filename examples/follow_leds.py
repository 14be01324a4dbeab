"""Light runs through the swarm: who sees a neighbour alight lights up after a moment, each robot by its own clock."""

from swarm import PeriodicApp, parameter


class FollowLeds(PeriodicApp):
    """`swarm sim examples/follow_leds.py --set r0.first=true`; `swarm app param follow_leds hold=1.0` while it runs."""

    lit: bool
    period = 0.2
    first: bool = parameter(False)
    hold: float = parameter(0.4, unit="s", low=0.1, high=5)
    _rest: float = 0.0

    def step(self, neighbours):
        """Be alight for `hold` s, then dark for three times as long; light up when a neighbour is, or as the first."""
        self._rest -= self.period
        if self._rest <= 0 and (self.lit or self.first or any(n.lit for n in neighbours)):
            self.lit = not self.lit
            self._rest = self.hold if self.lit else 3 * self.hold
        self.robot.leds(green=self.lit)
