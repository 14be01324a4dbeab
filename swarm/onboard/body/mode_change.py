"""The outcome of a mode command to one robot, from what its balancer publishes; no IO."""

from swarm.frozen import frozen
from swarm.messages import BalancerFault, BalancerState, Notice

COMMANDS = {"stand": "stand", "rest": "rest", "lie": "lie", "zero": "calibrate"}
"""Mode of `balancer/set/mode` by the word that a person types."""

AGAIN_S = 1.0
"""Seconds without any reaction after which the command is given again: a bus may lose it."""
STUCK_S = 1.5
"""Seconds that a robot stays in its old fault after a command before the fault counts as the answer."""
STANDS_S = 1.5
"""Seconds of balancing after which a robot stands: a stop that holds is said again each second."""

ZERO_TRIES = 5
"""Tries to find the gyro's zero: a robot at rest seems to move for single ticks, and then refuses to look for it."""

_WAY_OUT = {
    "stand": "swarm doctor tells what is wrong",
    "rest": "swarm estop stops it in any case",
    "lie": "swarm balance rest switches its motors off, swarm balance stand makes it stand",
    "zero": "swarm balance lie lays a standing robot down, swarm balance rest ends a fault; then leave it alone and "
    "give the command again",
}
"""What a person can do after a refusal that does not say so itself, by command."""


@frozen
class ModeOutcome:
    """The outcome of a change of mode on one robot."""

    ok: bool
    text: str
    """The outcome in words; after a refusal also the command that helps."""


class ModeChange:
    """One command to one robot; `outcome` is None as long as nothing is decided."""

    def __init__(self, command: str) -> None:
        """`command`: one of `COMMANDS`."""
        self._command = command
        self._mode: str | None = None
        self._posture = ""
        self._given: float | None = None
        self._stuck_since: float | None = None
        self._balances_since: float | None = None
        self._tries = 0
        self._reacted = False
        self._old_fault = False
        self._fault = BalancerFault(0.0, "", "", "")
        self.outcome: ModeOutcome | None = None

    def due(self, now: float) -> bool:
        """Return whether the command is to be given now: once the robot's state is known, and again without a
        reaction."""
        if self.outcome is not None or self._mode is None or self._reacted:
            return False
        if self._given is not None and now < self._given + AGAIN_S:
            return False
        self._given = now
        self._tries += 1
        return True

    def receive(self, message: object) -> None:
        """Take a message of the robot's balancer. A message of another kind does nothing."""
        if self.outcome is not None:
            return
        match message:
            case BalancerState():
                self._see(message)
            case BalancerFault():
                self._fault = message
            case Notice(_, "calibrate", text) if self._command == "zero" and self._given is not None:
                self._decide(text == "done", "the gyro's zero is found" if text == "done" else text)
            case Notice(_, "mode", text) if self._given is not None:
                if self._command != "zero" or "at rest" not in text or self._tries >= ZERO_TRIES:
                    self._decide(False, text)

    def silent(self) -> None:
        """Decide where the balancer has said nothing at all up to now."""
        if self._mode is None and self.outcome is None:
            self._end(False, "its balancer does not answer: swarm doctor tells why")

    def give_up(self, seconds: float) -> ModeOutcome:
        """Return the outcome after that time, s, whatever is known by then."""
        if self.outcome is None:
            self.silent()
            if self._mode == "fault":
                self._fail()
            elif self._mode is not None:
                self._decide(False, f"still {self._mode.replace('_', ' ')} after {seconds:g} s")
        assert self.outcome is not None
        return self.outcome

    def _see(self, state: BalancerState) -> None:
        first, self._mode, self._posture = self._mode is None, state.mode, state.posture
        if first:
            self._old_fault = state.mode == "fault"
        if self._given is None:
            return
        if state.mode == "fault":
            self._in_fault(state)
            return
        self._old_fault, self._stuck_since = False, None
        if self._command == "stand":
            self._reacted = self._reacted or state.mode != "idle"
            if state.mode != "balancing":
                self._balances_since = None
            elif self._balances_since is None:
                self._balances_since = state.t
            elif state.t - self._balances_since >= STANDS_S:
                self._end(True, "stands")
        elif self._command == "rest":
            if state.mode in ("idle", "calibrating", "starting"):
                self._end(True, f"{self._place()}, motors off")
        elif self._command == "lie":
            if state.mode == "lying_down":
                self._reacted = True
            elif self._reacted and state.mode == "idle":
                self._end(True, f"{self._place()}, motors off")
        else:
            self._reacted = self._reacted or state.mode == "calibrating"

    def _in_fault(self, state: BalancerState) -> None:
        """Fail if the robot stays in a fault. The command ends an old fault within two ticks; a new fault is the
        answer."""
        if self._stuck_since is None:
            self._stuck_since = state.t
        # The first message of the state may overtake that of the fault, which has the way out.
        patience = STUCK_S if self._old_fault else 0.2
        if self._fault.name and state.t - self._stuck_since >= patience:
            self._fail()

    def _fail(self) -> None:
        fault = self._fault
        if not fault.name:
            self._decide(False, "it is in a fault")
            return
        self._end(False, f"{fault.reason}: {fault.recovery}")

    def _decide(self, ok: bool, text: str) -> None:
        text = text.removeprefix("refused: ")
        self._end(ok, text if ok or "swarm " in text else f"{text}: {_WAY_OUT[self._command]}")

    def _end(self, ok: bool, text: str) -> None:
        self.outcome = ModeOutcome(ok, text)

    def _place(self) -> str:
        return {"front": "lies on its front", "back": "lies on its back"}.get(self._posture, f"is {self._posture}")
