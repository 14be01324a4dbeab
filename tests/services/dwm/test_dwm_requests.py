"""Requests to a module over the bus, at a port and behind the ATmega; a module in shell mode."""

import logging
import threading
import time
from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest
from conftest import CONFIG, stop, wait_until
from dwm_frames import LOCATION
from dwm_rig import ANCHORS, DWM, working

from services.dwm.balancer_block import MAX_WAITING, arrivals
from services.dwm.core.module.calls import CFG_GET, VER_GET
from services.dwm.core.module.tlv import encode_refusal
from services.dwm.line import BusLine, NoAnswerError
from services.dwm.requests import MAX_OPEN, ModuleRequests
from swarm import config as configuration
from swarm.bus.zenoh_bus import Bus
from swarm.messages import ModuleAnswer, ModuleRequest, Ranges, Status, Uwb, UwbRange
from swarm.messages.codec import decode, encode

REPORT = Uwb(0.0, "ok", 0, 0, 1, 0, 0.02, 2.635, 1.055, 3.74, 100, 4, tuple(
    UwbRange(r.anchor, r.distance, r.quality, r.position.x, r.position.y, r.position.z, r.position.quality)
    for r in LOCATION.ranges
))  # fmt: skip


@pytest.fixture
def board(processes, runtime):
    processes.config.write_text(CONFIG.format(runtime=runtime) + ANCHORS + DWM.format(directory=runtime))
    with working(runtime, configuration.load(processes.config), "r0") as board:
        yield board


@pytest.fixture
def bus(router, runtime):
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
        yield bus


def heard(bus, kind, key):
    found = []
    bus.subscribe(key, lambda name, payload: found.append(decode(kind, payload, name)))
    return found


def test_a_repeated_request_is_done_once_and_answered_again(processes, board, bus):
    process = processes.start_ready("-m", "services.dwm")
    answers = heard(bus, ModuleAnswer, "swarm/r0/dwm/module")
    request = ModuleRequest("t1", VER_GET.request)

    def answered(count):
        if len(answers) < count:
            bus.publish("swarm/r0/dwm/set/module", request)
            time.sleep(0.2)
        return len(answers) >= count

    wait_until(lambda: answered(3), what="three answers")
    assert {(answer.ticket, answer.answer, answer.problem) for answer in answers} == {
        ("t1", bytes.fromhex("400100 5004 01000301 5104 00070100 5204 2a00cade"), "")
    }
    bus.publish("swarm/r0/dwm/set/module", ModuleRequest("t2", b"\x13\x00"))
    wait_until(lambda: any(answer.ticket == "t2" for answer in answers), what="a refusal")
    assert "not one of the calls" in answers[-1].problem
    bus.publish("swarm/r0/dwm/set/module", b"nonsense")
    bus.publish("swarm/r0/dwm/set/module", ModuleRequest("t3", bytes(300)))
    states = heard(bus, Status, "swarm/r0/dwm/status")
    bus.publish("swarm/r0/dwm/set/module", ModuleRequest("t4", VER_GET.request))
    wait_until(lambda: answers[-1].ticket == "t4", what="it goes on")
    assert stop(process) == 0
    wait_until(lambda: states, what="its last words")
    assert not any(answer.ticket == "t3" for answer in answers)
    assert states[-1].counters["refused_payloads"] == 2


def test_requests_while_the_port_is_gone(processes, board, bus):
    processes.start_ready("-m", "services.dwm")
    board.remove("r0")
    line = BusLine("r0", processes.runtime)
    with pytest.raises(NoAnswerError, match=r"dwm\.tty|does not answer"):
        line.ask(VER_GET)
    line.close()


def test_a_module_in_shell_mode_is_told_to_leave_it(processes, board, bus):
    states = heard(bus, Status, "swarm/r0/dwm/status")
    ranges = heard(bus, Ranges, "swarm/r0/dwm/ranges")
    processes.start_ready("-m", "services.dwm")
    wait_until(lambda: ranges, what="ranges")
    board.module("r0").in_shell = True

    def told() -> bool:
        return any("shell mode" in state.reason for state in states if state.state == "degraded")

    wait_until(told, what="the shell mode is told")
    wait_until(lambda: states[-1].state == "ready", what="ready")


class Balancer:
    """Stands in for a balancer whose ATmega has a module: tells reports, passes requests on."""

    def __init__(self, bus):
        self.requests, self.state = [], "ok"
        self._bus = bus
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work)
        bus.subscribe("swarm/r0/balancer/set/module", self._request)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ending.set()
        self._thread.join()

    def _request(self, name, payload):
        request = decode(ModuleRequest, payload, name)
        self.requests.append(request)
        if len(self.requests) > 1:  # the first one gets lost
            answer = ModuleAnswer(time.monotonic(), request.ticket, encode_refusal(4), "")
            self._bus.publish("swarm/r0/balancer/module", answer)

    def _work(self):
        sequence = 0
        while not self._ending.wait(0.05):
            sequence += self.state == "ok"
            values = {name: getattr(REPORT, name) for name in Uwb.__slots__}
            values |= {"t": time.monotonic(), "sequence": sequence, "state": self.state, "x": 2.0 + sequence / 1000}
            self._bus.publish("swarm/r0/balancer/uwb", Uwb(**values))


def test_a_module_behind_the_atmega(processes, bus):
    processes.config.write_text(processes.config.read_text() + '[dwm]\nsource = "balancer"\n')
    ranges = heard(bus, Ranges, "swarm/r0/dwm/ranges")
    states = heard(bus, Status, "swarm/r0/dwm/status")
    with Balancer(bus) as balancer:
        process = processes.start_ready("-m", "services.dwm")
        wait_until(lambda: len(ranges) > 5, what="ranges")
        assert {item.anchor for item in ranges[-1].ranges} == {"C933", "D001", "D002", "D003"}
        assert abs(time.monotonic() - ranges[-1].t) < 60, "by the same clock"
        line = BusLine("r0", processes.runtime)
        with pytest.raises(NoAnswerError, match="refuses cfg_get: busy"):
            line.ask(CFG_GET)
        line.close()
        assert [request.request for request in balancer.requests] == [CFG_GET.request] * 2
        assert len({request.ticket for request in balancer.requests}) == 1
        balancer.state = "silent"
        wait_until(lambda: states and "does not answer the ATmega" in states[-1].reason, what="its reason")
        balancer.state = "ok"
        wait_until(lambda: states[-1].state == "ready", what="ready again")
    wait_until(lambda: "is it running" in states[-1].reason, what="the balancer's absence")
    assert stop(process) == 0


def test_a_module_that_did_not_answer_its_service_is_asked_again(bus, runtime):
    """As at a port: a byte may get lost."""
    asked = []

    def answer(name, payload):
        asked.append(decode(ModuleRequest, payload, name).ticket)
        said = (b"", "the module is silent") if len(set(asked)) < 3 else (encode_refusal(4), "")
        bus.publish("swarm/r0/dwm/module", ModuleAnswer(time.monotonic(), asked[-1], *said))

    bus.subscribe("swarm/r0/dwm/set/module", answer)
    line = BusLine("r0", runtime)
    try:
        with pytest.raises(NoAnswerError, match="refuses cfg_get: busy"):
            line.ask(CFG_GET)
    finally:
        line.close()
    assert len(set(asked)) == 3


def asked_by_hand(*, repeats: bool = False):
    """Requests, what takes a sample of them, the answers and the service's counters."""
    service, listeners, answers = service_by_hand()
    requests = ModuleRequests(service, lambda: None, repeats=repeats)
    return requests, listeners["swarm/r0/dwm/set/module"], answers, service.counters


def service_by_hand():
    """Return a service without a bus, what takes the samples of each key, and the answers that it publishes."""
    answers: list[ModuleAnswer] = []
    listeners = {}
    bus = SimpleNamespace(
        publish=lambda key, message: answers.append(message), subscribe=lambda key, take: listeners.update({key: take})
    )
    service: Any = SimpleNamespace(robot="r0", bus=bus, counters=Counter(), log=logging.getLogger("dwm"))
    return service, listeners, answers


def test_reports_that_nobody_takes_do_not_pile_up() -> None:
    service, listeners, _ = service_by_hand()
    arrived = arrivals(service)
    for _ in range(MAX_WAITING):
        listeners["swarm/r0/balancer/uwb"]("key", encode(REPORT))
        listeners["swarm/r0/balancer/module"]("key", encode(ModuleAnswer(0.0, "t0", b"", "")))
    assert arrived.qsize() == service.counters["refused_payloads"] == MAX_WAITING


@pytest.mark.parametrize("repeats", [False, True])
def test_requests_that_nobody_takes_do_not_pile_up(repeats: bool) -> None:
    requests, take, answers, counters = asked_by_hand(repeats=repeats)
    for number in range(1000):
        take("key", encode(ModuleRequest(f"t{number}", VER_GET.request)))
        take("key", encode(ModuleRequest("t0", VER_GET.request)))
    waiting = [request.ticket for request in requests.new()]
    assert len(waiting) == MAX_OPEN
    assert counters["refused_payloads"] >= 900
    take("key", encode(ModuleRequest("t999", VER_GET.request)))
    assert [request.ticket for request in requests.new()] == ["t999"]
    requests.answer("t999", b"yes", "")
    assert answers[-1].ticket == "t999"


def test_all_requests_are_answered_when_the_module_is_gone() -> None:
    """Also one that was taken already, to be sent to the module."""
    requests, take, answers, _ = asked_by_hand()
    for ticket in "ab":
        take("key", encode(ModuleRequest(ticket, VER_GET.request)))
    assert [request.ticket for request in requests.new()] == ["a", "b"]
    take("key", encode(ModuleRequest("c", VER_GET.request)))
    requests.answer("a", b"yes", "")
    requests.fail("no such device")
    assert [(answer.ticket, answer.problem) for answer in answers] == [
        ("a", ""),
        ("b", "no such device"),
        ("c", "no such device"),
    ]
    assert requests.new() == []
