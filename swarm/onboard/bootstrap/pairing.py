"""The part of one robot in pairing: look, forget, wait for a call, or call.

Just Works with agents that have neither input nor output (Core Specification, vol 3 C, 5.2.2.5): nobody stands beside
the robots. Who may pair is decided by address, for the time of one pairing only.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from typing import Any

from swarm.onboard.bootstrap.bluez import Bluez, BluezError

PAIR_S = 30.0

_REASONS = {
    "org.bluez.Error.AuthenticationFailed": "the other side has another key, or none",
    "org.bluez.Error.AuthenticationRejected": "the other side's agent said no",
    "org.bluez.Error.AuthenticationCanceled": "it was given up",
    "org.bluez.Error.AuthenticationTimeout": "the other side did not answer in time",
    "org.bluez.Error.ConnectionAttemptFailed": "the other side cannot be reached: out of range, or busy",
    "org.freedesktop.DBus.Error.ServiceUnknown": "bluetoothd does not run: systemctl status bluetooth",
    "org.freedesktop.DBus.Error.NameHasNoOwner": "bluetoothd does not run: systemctl status bluetooth",
    "no-adapter": "there is no Bluetooth adapter: swarm doctor says why",
}


def main(request: dict[str, Any], tell: Callable[[object], None]) -> dict[str, Any]:
    """Carry out a request: do (look, forget, trust, listen, call), peer, adapter, inquiry (s). `problem` is empty if
    all went well.

    Changes are on the disk at the end: a robot whose power goes after `swarm pair` still has its keys.
    """
    try:
        bluez = Bluez(request.get("adapter"))
    except BluezError as error:
        return {"problem": _explain(error)}
    try:
        _DO[request["do"]](bluez, request, tell)
        # bluetoothd writes its files when it is idle, so before it answers this; it does not sync them.
        found = _look(bluez)
        if request["do"] != "look":
            os.sync()
    except BluezError as error:
        return {"problem": _explain(error)}
    else:
        return {"problem": "", **found}
    finally:
        bluez.close()


def _explain(error: BluezError) -> str:
    foreign = error.name.startswith("org.") and str(error) != error.name
    return _REASONS.get(error.name, f"{error} ({error.name})" if foreign else str(error))


def _look(bluez: Bluez) -> dict[str, Any]:
    state = bluez.state()
    devices = {
        device["Address"]: {
            "paired": bool(device.get("Paired")) and bool(device.get("Bonded", True)),  # Bonded came with BlueZ 5.66
            "trusted": bool(device.get("Trusted")),
        }
        for device in bluez.devices()
    }
    return {"address": state["Address"], "powered": state["Powered"], "devices": devices}


def _nothing(bluez: Bluez, request: dict[str, Any], tell: Callable[[object], None]) -> None:
    """Change nothing: the step of a request that only looks."""


def _forget(bluez: Bluez, request: dict[str, Any], tell: Callable[[object], None]) -> None:
    if bluez.device(request["peer"]) is not None:
        bluez.forget(request["peer"])


def _trust(bluez: Bluez, request: dict[str, Any], tell: Callable[[object], None]) -> None:
    bluez.trust(request["peer"])


def _ready(bluez: Bluez, peer: str) -> None:
    if not bluez.state()["Powered"]:
        bluez.set_adapter("Powered", True)
    bluez.set_adapter("Pairable", True)
    bluez.be_agent(peer)


def _listen(bluez: Bluez, request: dict[str, Any], tell: Callable[[object], None]) -> None:
    """Be found and say yes to the peer, until it is paired or our input ends (the laptop has given it up)."""
    peer = request["peer"]
    _ready(bluez, peer)
    bluez.set_adapter("Discoverable", True)
    tell({"listening": True})
    try:
        seconds = request["inquiry"] + PAIR_S + 10
        if not bluez.wait(lambda: bool((bluez.device(peer) or {}).get("Paired")), seconds, stop=sys.stdin.fileno()):
            raise BluezError("not-called", f"{peer} has not paired with it")
        bluez.trust(peer)
    finally:
        with contextlib.suppress(BluezError):
            bluez.set_adapter("Discoverable", False)


def _call(bluez: Bluez, request: dict[str, Any], tell: Callable[[object], None]) -> None:
    """Find the peer, pair with it and trust it."""
    peer = request["peer"]
    _ready(bluez, peer)
    if bluez.device(peer) is None:
        bluez.inquire()
        try:
            if not bluez.wait(lambda: bluez.device(peer) is not None, request["inquiry"]):
                raise BluezError("not-found", f"{peer} was not found within {request['inquiry']:g} s: is it in range?")
        finally:
            with contextlib.suppress(BluezError):
                bluez.stop_inquiry()
    try:
        bluez.pair(peer, PAIR_S)
    except BluezError as error:
        if error.name != "org.bluez.Error.AlreadyExists":
            raise
    bluez.trust(peer)


_DO = {"look": _nothing, "forget": _forget, "trust": _trust, "listen": _listen, "call": _call}
