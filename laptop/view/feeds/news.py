"""What a message says that a person should read once."""

from collections.abc import Iterator

MAX_NAMED = 6
"""The most robots that an event names as waited for."""

REACH = "view/reach"
"""Topic that the laptop adds for a real robot: `by` what it is reached (ssh, the mesh, or nothing), and `why` not."""


def news(topic: str, value: object) -> Iterator[tuple[str, str, str]]:
    """Yield level, text and subject of what a message says that a person should read once."""
    if not isinstance(value, dict):
        return
    service, _, kind = topic.rpartition("/")
    if topic == "mesh/links":
        for link in value.get("links") or ():
            if isinstance(link, dict):
                state, reason = link.get("state"), link.get("reason")
                begins = reason == "not connected yet"
                level = "info" if begins else {"up": "info", "connecting": "info"}.get(str(state), "warning")
                text = f"link to {link.get('peer')} {state}" + (f": {reason}" if reason and state == "down" else "")
                if state != "connecting":
                    yield level, text, f"link {link.get('peer')}"
    elif kind == "status":
        state = value.get("state")
        level = "warning" if state == "degraded" else "info"
        yield level, f"{service} {state}" + (f": {value['reason']}" if value.get("reason") else ""), service
    elif kind == "progress" and service.startswith("app/"):
        phase, waiting = value.get("phase"), value.get("waiting_for") or []
        text = f"{service} {phase}"
        if isinstance(waiting, list) and waiting:
            text += " for " + " ".join(map(str, waiting[:MAX_NAMED]))
            if len(waiting) > MAX_NAMED:
                text += f" and {len(waiting) - MAX_NAMED} more"
        if value.get("reason"):
            text += f": {value['reason']}"
        waits = "warning" if value.get("k") else "info"  # before the first iteration robots only come together
        yield {"fault": "error", "waiting": waits}.get(str(phase), "info"), text, f"{service} phase"
    elif topic == "balancer/fault":
        name = value.get("name")
        yield "error" if name else "info", f"fault: {value.get('reason')}" if name else "no fault", "fault"
    elif topic == REACH:
        by, why = value.get("by"), value.get("why")
        yield ("info", f"seen by {by}", "reach") if by else ("warning", f"out of reach: {why}", "reach")
    elif topic == "mesh/stopped":
        stopped = value.get("stopped")
        yield "error" if stopped else "info", "stopped" if stopped else "not stopped", "stopped"
