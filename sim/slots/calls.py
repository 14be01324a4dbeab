"""The calls that make links of a slot radio: pages that are heard in scans, and the exchanges until a socket is
connected.

Paging takes a device's time like one more piconet, with longer stays. The called one hears it in its scans, which take
time of its own; that its scans always meet the right train of frequencies is fitted to recorded starts. A controller
pages one at a time; what else its host wants waits (newer Linux kernels; older ones give up at the third refusal).
"""

from collections import deque
from collections.abc import Callable

from sim.slots.devices import PAGE, RadioDevice, RadioLink
from sim.slots.radio import EventClock, SlotRadio

ABSENT = "not in range, switched off, or deaf"
BUSY = "an earlier connection to it has not ended yet"
FULL = "the caller's piconet is full"
LATE = "no connection in time"

SMALL = 12
"""Bytes of a frame of the set-up."""


class CallAttempt:
    """One attempt to make a link."""

    def __init__(self, caller: str, called: str, timeout: float, done: Callable[[RadioLink | None, str], None]) -> None:
        self.caller, self.called, self.timeout = caller, called, timeout
        self.done = done
        """Called once, with the link or with the reason why there is none."""
        self.link: RadioLink | None = None
        self.step = 0


class Calls:
    """The calls of all robots."""

    def __init__(self, clock: EventClock, radio: SlotRadio) -> None:
        self._clock = clock
        self._radio = radio
        self._waiting: dict[str, deque[CallAttempt]] = {}
        self._paging: dict[str, CallAttempt] = {}
        """The call that is being paged, by caller."""
        self.reachable: set[str] = set()
        """The devices that scan for pages."""
        self.scans: dict[str, tuple[float, float]] = {}
        """By device: seconds from one page scan to the next, and how long one takes."""
        for name in radio.devices:
            self.add(name)

    def add(self, name: str) -> None:
        """Let a device of the radio make calls and scan for them."""
        parameters = self._radio.parameters
        self._waiting[name] = deque()
        self.scans[name] = parameters.scan, parameters.scan_window
        self._clock.at(self._clock.now + self._radio.random.random() * parameters.scan, self._scan, name)

    def call(
        self, caller: str, called: str, timeout: float, done: Callable[[RadioLink | None, str], None]
    ) -> CallAttempt:
        """Make a link; `done(link, reason)` is called at its end, with None `timeout` s after its page has begun at the
        latest."""
        call = CallAttempt(caller, called, timeout, done)
        self._waiting[caller].append(call)
        self._next(caller)
        return call

    def cancel(self, call: CallAttempt) -> None:
        """End a call about whose end nobody wants to hear."""
        call.done = lambda link, reason: None
        self._end(call, "")

    def switch_off(self, name: str) -> None:
        """Forget the calls of a device that has lost its power."""
        waiting, self._waiting[name] = self._waiting[name], deque()
        for call in waiting:
            self.cancel(call)
        if (paging := self._paging.get(name)) is not None:
            self.cancel(paging)

    def _next(self, caller: str) -> None:
        radio = self._radio
        while caller not in self._paging and self._waiting[caller]:
            call = self._waiting[caller].popleft()
            if call.step < 0:
                continue
            there = {end.device.name for each in radio.devices[caller].links for end in (each.central, each.peripheral)}
            if call.called in there or not radio.has_room(caller):
                self._end(call, BUSY if call.called in there else FULL)
                continue
            self._paging[caller] = call
            radio.take_role(radio.devices[caller], PAGE)
            self._clock.at(self._clock.now + radio.parameters.page_timeout, self._page_failed, call)
            self._clock.at(self._clock.now + call.timeout, self._end, call, LATE)

    def _page_failed(self, call: CallAttempt) -> None:
        if self._paging.get(call.caller) is call:
            self._end(call, ABSENT)

    def _scan(self, name: str) -> None:
        radio, now = self._radio, self._clock.now
        parameters, device = radio.parameters, radio.devices[name]
        period, window = self.scans[name]
        self._clock.at(now + period, self._scan, name)
        skipped = device.tuned == PAGE and radio.random.random() >= parameters.scan_paging
        if name not in self.reachable or skipped:
            return
        device.scanning = now + window
        for caller, call in self._paging.items():
            if call.called == name and radio.devices[caller].is_in(PAGE, now):
                if radio.passes(caller, name):
                    self._clock.at(now + parameters.page_answer, self._answered, call, device)
                return

    def _answered(self, call: CallAttempt, device: RadioDevice) -> None:
        """Make the link, unless the device that has heard the page has lost its power meanwhile."""
        if self._paging.get(call.caller) is not call or self._radio.devices[call.called] is not device:
            return
        self._hang_up_page(call)
        call.link = link = self._radio.connect(call.caller, call.called)
        link.lost = lambda: self._end(call, LATE)
        self._set_up(call)

    def _set_up(self, call: CallAttempt) -> None:
        """Send the next frame of the set-up, from either side in turn. After the last one the link is the caller's
        own."""
        if call.step < 0 or call.link is None:
            return
        if call.step == 2 * self._radio.parameters.setup:
            call.step = -1
            call.link.lost = lambda: None
            call.done(call.link, "")
            return
        sender = call.called if call.step % 2 else call.caller
        call.step += 1
        self._radio.send(call.link, sender, SMALL, lambda: self._set_up(call))

    def _hang_up_page(self, call: CallAttempt) -> None:
        del self._paging[call.caller]
        self._radio.leave_role(self._radio.devices[call.caller], PAGE)
        self._clock.at(self._clock.now, self._next, call.caller)

    def _end(self, call: CallAttempt, reason: str) -> None:
        """End a call with a reason; do nothing if it has ended."""
        if call.step < 0:
            return
        call.step = -1
        if self._paging.get(call.caller) is call:
            self._hang_up_page(call)
        if call.link is not None:
            self._radio.drop(call.link)
        self._clock.at(self._clock.now, call.done, None, reason)  # its caller is still about to call
