"""The reports of the loop on the balancer, as messages; a few at each tick."""

from services.balancer.balancer import Balancer
from swarm import clock
from swarm.messages import BalancerFault, BalancerState, Notice, Odometry, Parameters


class Telemetry:
    """Makes the messages, and knows what was told already."""

    def __init__(self, balancer: Balancer, controller: str) -> None:
        """`controller` as configured, for the parameters' message."""
        self._balancer = balancer
        self._controller = controller
        self._sequence = 0
        self._fault_told = balancer.fault
        self._parameters_told: dict[str, float] = {}

    def state(
        self, ticks: int, missed: int, bus_errors: int, lateness: tuple[float, float], behind: str
    ) -> BalancerState:
        """The body; the counters are the loop's, `behind` that of its slack tasks."""
        balancer, estimate = self._balancer, self._balancer.estimate
        fault = balancer.fault
        demanded_speed, demanded_turn_rate = balancer.demand
        return BalancerState(
            t=clock.now() if estimate is None or not balancer.connected else estimate.t,
            mode=balancer.mode,
            tilt=0.0 if estimate is None else estimate.tilt,
            tilt_rate=0.0 if estimate is None else estimate.tilt_rate,
            speed=0.0 if estimate is None else estimate.speed,
            duty_left=balancer.duty[0],
            duty_right=balancer.duty[1],
            battery=balancer.battery,
            ticks=ticks,
            late_p99=lateness[0],
            late_max=lateness[1],
            fault="" if fault is None else fault.reason,
            missed=missed,
            bus_errors=bus_errors,
            posture=balancer.posture,
            demanded_speed=demanded_speed,
            demanded_turn_rate=demanded_turn_rate,
            battery_level=balancer.battery_level,
            battery_left=balancer.battery_time_left,
            scl=balancer.wire.scl,
            behind=behind,
        )

    def odometry(self) -> Odometry | None:
        """Return the body's own motion; None before the first estimate, and while the devices are away."""
        estimate = self._balancer.estimate
        if estimate is None or not self._balancer.connected:
            return None
        self._sequence += 1
        return Odometry(
            t=estimate.t,
            sequence=self._sequence,
            left=estimate.left,
            right=estimate.right,
            x=estimate.x,
            y=estimate.y,
            heading=estimate.heading,
            gyro_heading=estimate.gyro_heading,
            wheel_heading=estimate.wheel_heading,
            tilt=estimate.tilt,
        )

    def news(self) -> BalancerFault | Notice | Parameters | None:
        """Return one message that is new: the fault first."""
        if self._balancer.fault != self._fault_told:
            return self.fault()
        if self._balancer.notices:
            return Notice(clock.now(), *self._balancer.notices.popleft())
        if self._balancer.parameters != self._parameters_told:
            return self.parameters()
        return None

    def fault(self) -> BalancerFault:
        """Return the fault as it is."""
        self._fault_told = fault = self._balancer.fault
        if fault is None:
            return BalancerFault(clock.now(), "", "", "")
        return BalancerFault(clock.now(), fault.name, fault.reason, fault.recovery)

    def parameters(self) -> Parameters:
        """Return the parameters as they are."""
        self._parameters_told = dict(self._balancer.parameters)
        return Parameters(clock.now(), self._controller, self._parameters_told)
