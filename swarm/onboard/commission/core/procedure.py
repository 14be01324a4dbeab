"""The steps of commissioning, one after the other: each must pass before the next is begun.

A step is a generator that yields whenever it waits, and is gone on with at each event and at each tick of the shell.
What it wants done it leaves at the `Desk`: things to say, questions, commands to the robot. A step that fails ends with
`StepError`; the motors are off then, and the person may mend what it names and try the same step again.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any, NamedTuple

from swarm.frozen import frozen
from swarm.messages import Buttons, SetMode
from swarm.onboard.commission.core.robot_view import RobotView

Script = Generator[None, None, None]
Condition = Callable[[], object]

PASSED, FAILED, NOT_TRIED = "passed", "failed", "not tried"


@frozen
class Subject:
    """The robot to commission, with its configuration."""

    robot: str
    anchors: Mapping[str, tuple[float, float, float]]
    """The anchors that it should hear: places by short address, m, heights over the robots' antennas."""
    battery_warning: float
    """Voltage below which the balancer warns, V."""
    date: str
    """Time at which the procedure began, as text; it also names the requests."""
    release: str


@frozen
class Say:
    """Write a line for the person."""

    text: str


@frozen
class Ask:
    """Ask the person for an act; where `answered`, wait for button A or a key: yes; button C: no."""

    what: str
    """A name for the act, the same in each commissioning."""
    text: str
    answered: bool


@frozen
class SendCommand:
    """Send a command to the robot; which key it goes to follows from its type."""

    message: object


Action = Say | Ask | SendCommand


class StepError(Exception):
    """A step has not passed: what is wrong, and what to mend."""

    def __init__(self, text: str, remedy: str) -> None:
        super().__init__(text)
        self.text, self.remedy = text, remedy


class Desk:
    """The tools of a step: the robot's view, prompts, commands and figures."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.robot = RobotView()
        self.now = 0.0
        """Time of the shell's clock, s."""
        self.figures: dict[str, Any] = {}
        """Figures that the step that runs has measured, with names that end in their unit."""
        self.actions: list[Action] = []
        self.answer: bool | None = None
        self.asking = False
        """Whether the step waits for an answer."""

    def say(self, text: str) -> None:
        """Tell the person something."""
        self.actions.append(Say(text))

    def send(self, message: object) -> None:
        """Send a command to the robot."""
        self.actions.append(SendCommand(message))

    def prompt(self, what: str, text: str) -> None:
        """Ask for an act whose effect shows by itself."""
        self.actions.append(Ask(what, text, answered=False))

    def question(self, what: str, text: str) -> Generator[None, None, bool]:
        """Ask, and wait for the answer: True for yes."""
        self.actions.append(Ask(what, text, answered=True))
        self.answer, self.asking = None, True
        while self.answer is None:
            yield
        self.asking = False
        return self.answer

    def confirm(self, what: str, text: str) -> Script:
        """Ask for an act, and wait until it is done; raises `StepError` where the person says no."""
        if not (yield from self.question(what, text)):
            raise StepError("the person has said no", "begin again when it can be done")

    def wait(self, seconds: float) -> Script:
        """Let that time pass."""
        end = self.now + seconds
        while self.now < end:
            yield

    def until(self, condition: Condition, seconds: float) -> Generator[None, None, bool]:
        """Wait until the condition holds, at most so long. Return whether it does."""
        end = self.now + seconds
        while not condition():
            if self.now >= end:
                return False
            yield
        return True


class ProcedureStep(NamedTuple):
    """One step of the procedure."""

    name: str
    title: str
    script: Callable[[Desk], Script]


@frozen
class StepResult:
    """The result of a step, of several tries that of the last one."""

    name: str
    verdict: str
    """passed, failed or not tried."""
    tries: int
    figures: dict[str, Any]
    text: str = ""
    """What is wrong, in words."""
    remedy: str = ""


class Procedure:
    """The whole procedure. At its end it is `done`, and there is a `report`."""

    def __init__(self, subject: Subject, steps: Sequence[ProcedureStep]) -> None:
        self.desk = Desk(subject)
        self._steps = steps
        self._script = self._run()
        self.results: dict[str, StepResult] = {}
        self.done = False

    def receive(self, message: object, now: float) -> list[Action]:
        """Take a message of the robot; returns what is to be done."""
        if isinstance(message, Buttons):
            self._pressed(message)
        self.desk.robot.receive(message)
        return self.handle_timer(now)

    def answer(self, yes: bool, now: float) -> list[Action]:
        """Take the person's answer, which counts only where one is waited for; returns what is to be done."""
        if self.desk.asking:
            self.desk.answer = yes
        return self.handle_timer(now)

    def handle_timer(self, now: float) -> list[Action]:
        """Go on, at least twenty times a second; returns what is to be done."""
        self.desk.now = now
        if not self.done:
            try:
                next(self._script)
            except StopIteration:
                self.done = True
        actions, self.desk.actions = self.desk.actions, []
        return actions

    @property
    def passed(self) -> bool:
        """Whether all steps have passed."""
        return all(self._result(step).verdict == PASSED for step in self._steps)

    def report(self) -> dict[str, Any]:
        """Return the report as it is now."""
        subject = self.desk.subject
        return {
            "report": 1,
            "robot": subject.robot,
            "date": subject.date,
            "release": subject.release,
            "verdict": PASSED if self.passed else FAILED,
            "steps": [
                {"name": each.name, "verdict": each.verdict, "tries": each.tries, "figures": each.figures}
                | ({"text": each.text, "remedy": each.remedy} if each.text else {})
                for each in map(self._result, self._steps)
            ],
        }

    def _result(self, step: ProcedureStep) -> StepResult:
        return self.results.get(step.name, StepResult(step.name, NOT_TRIED, 0, {}))

    def _pressed(self, buttons: Buttons) -> None:
        before = self.desk.robot.buttons
        if before is None or not self.desk.asking:
            return
        if buttons.presses_a > before.presses_a:
            self.desk.answer = True
        elif buttons.presses_c > before.presses_c:
            self.desk.answer = False

    def _run(self) -> Script:
        desk = self.desk
        for number, step in enumerate(self._steps, 1):
            while True:
                desk.say(f"step {number} of {len(self._steps)}: {step.title}")
                if (yield from self._try(step)):
                    break
                again = yield from desk.question("again", "Mended? A or Enter: try this step again. C or n: end here.")
                if not again:
                    return

    def _try(self, step: ProcedureStep) -> Generator[None, None, bool]:
        desk = self.desk
        desk.figures = {}
        tries = self._result(step).tries + 1
        try:
            yield from step.script(desk)
        except StepError as failure:
            desk.send(SetMode("rest"))
            self.results[step.name] = StepResult(step.name, FAILED, tries, desk.figures, failure.text, failure.remedy)
            desk.say(f"FAILED: {failure.text}")
            desk.say(f"  -> {failure.remedy}")
            return False
        self.results[step.name] = StepResult(step.name, PASSED, tries, desk.figures)
        short = (f"{name} {value}" for name, value in desk.figures.items() if isinstance(value, int | float | str))
        desk.say(", ".join(["passed", *short]))
        return True
