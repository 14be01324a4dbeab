"""What commands of a laptop make of a robot whose release says less, more or something else than this one."""

import json
from dataclasses import replace
from typing import Any

from examined_robots import WELL, bus
from hypothesis import example, given
from hypothesis import strategies as st

from laptop.cli.robots import status
from laptop.fleet.core import doctor
from laptop.fleet.ssh.everyone import RobotOutcome

SAID: dict[str, Any] = {
    "balancer/state": {"mode": "balancing", "battery": 7.4, "battery_left": 9000, "fault": ""},
    "balancer/firmware": {"layout": 1, "revision": 4},
    "mesh/links": {"links": [{"peer": "r1", "state": "up"}, {"peer": "r2", "state": "down"}], "clashes": {}},
    "dwm/pose": {"x": 1.5, "y": 2.0, "quality": 90},
    "app/consensus/progress": {"phase": "running", "k": 12},
}
"""What `swarm status` looks at, as this release says it."""

OTHER = st.none() | st.booleans() | st.integers() | st.text(max_size=3) | st.lists(st.integers(), max_size=2) | (
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2)
)  # fmt: skip


@st.composite
def changed(draw: st.DrawFn, said: dict[str, Any]) -> dict[str, Any]:
    """The same topics with one field, at any depth, left out or replaced by another value."""
    topic = draw(st.sampled_from(sorted(said)))
    found = json.loads(json.dumps(said))
    place = found[topic]
    while isinstance(place, dict) and place:
        name = draw(st.sampled_from(sorted(place)))
        below = place[name]
        if isinstance(below, list) and below and isinstance(below[0], dict) and draw(st.booleans()):
            place = below[0]
            continue
        if draw(st.booleans()):
            del place[name]
        else:
            place[name] = draw(OTHER)
        break
    return found


@given(changed(SAID))
def test_a_status_row_leaves_out_what_another_release_does_not_say(said: dict[str, Any]) -> None:
    lines = [json.dumps({"key": f"swarm/r0/{topic}", "value": value}) for topic, value in said.items()]
    row = status.parse("r0", "== release\n/opt/swarm/releases/9.9\n== bus\n" + "\n".join(lines))
    assert row.release == "9.9"
    assert any("9.9" in line for line in status.table([RobotOutcome("r0", True, "", 1.0)], {"r0": row}, 2e9))


@given(changed({topic: value for topic, value in bus().items() if isinstance(value, dict)}))
@example(bus(balancer_state={"mode": ""}))
@example(bus(dwm_status={"state": "degraded", "reason": ""}))
def test_the_doctor_names_what_it_cannot_read_and_goes_on(said: dict[str, Any]) -> None:
    found = doctor.examine(replace(WELL, bus={**said, "bus": True}))
    assert set(found) == {check.name for check in doctor.CHECKS}
    assert all(each.text for each in found.values())


def test_the_doctor_says_that_the_release_may_be_another_one() -> None:
    found = doctor.examine(replace(WELL, bus=bus(mesh_clock={"origin": "r0"})))["time"]
    assert found.state == "bad"
    assert "release" in found.remedy
