"""`swarm app param`: what is no value, a change without an answer; `--fleet`: the robots' own commands, over ssh."""

import argparse

import pytest
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

from swarm.errors import LocalError
from swarm.onboard import param

pytest_plugins = ["fleet_fixtures"]

HOOK = """
case "$SSH_ORIGINAL_COMMAND" in
  *"/swarm app param consensus gain=0.5") echo done; exit 0 ;;
  *) echo "swarm: app consensus on r1: refused" >&2; exit 2 ;;
esac
"""


@needs_ssh
def test_each_robot_changes_what_is_meant_for_it(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("r0", "r1"):
        robots.add(name, hook=HOOK)
    assert run("app", "param", "consensus", "gain=0.5", "r1.x=2", "--fleet", "--json") == 1
    found = outcomes(capsys)
    assert (found["r0"]["ok"], found["r1"]["ok"]) == (True, False)
    assert "app consensus on r1: refused" in str(found["r1"]["text"])


class Mute:
    """A bus on which nobody answers."""

    def subscribe(self, *_: object) -> None: ...

    def publish(self, *_: object, urgent: bool) -> None: ...


@pytest.mark.parametrize("text", ["nan", "1e999", "-inf", str(1 << 64), "[1,nan]"])
def test_a_value_that_no_message_carries_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match=r"^r0\.gain: expected a finite number"):
        param.settings_of(argparse.Namespace(app="hands", settings=[f"r0.gain={text}"]))


def test_a_change_without_an_answer_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(param, "PATIENCE", 0.0)
    problems, changed = param._change({"r0": Mute(), "r1": Mute()}, "hands", {"r0": {"gain": 0.5}})  # type: ignore[dict-item]
    assert (list(problems), changed) == (["r0"], {})
    assert "no answer to the change" in problems["r0"]


@needs_ssh
def test_a_value_for_a_robot_that_is_not_asked_is_refused(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """In place of "nothing to change" on all others."""
    robots.add("r0", up=False)
    assert run("app", "param", "consensus", "r9.x=2", "--fleet") == 2
    assert "no robot 'r9' here, there are r0" in capsys.readouterr().err


@needs_ssh
def test_a_robots_own_value_goes_before_that_of_all_in_any_order(
    robots: FakeRobots, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    robots.add("r1", hook='echo "$SSH_ORIGINAL_COMMAND"; exit')
    assert run("app", "param", "consensus", "r1.gain=2", "gain=1", "--fleet") == 0
    assert "param consensus gain=1 gain=2\n" in capsys.readouterr().out
