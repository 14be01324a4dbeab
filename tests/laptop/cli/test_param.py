"""`swarm app param --fleet`: the robots' own commands, over ssh."""

import pytest
from fake_robots import FakeRobots, Run, outcomes
from needs import needs_ssh

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
