"""The questions of one page: stops are carried out at once, all else in turn, and an answer that the page does not read
holds up nothing."""

import asyncio
import contextlib
import json
from collections.abc import Awaitable, Callable
from typing import Any

MAX_WAITING = 32
"""The most questions of a page that wait for earlier ones, and the most answers that wait to be read."""

Answer = dict[str, Any]
"""`{"done": TEXT}`, `{"refused": TEXT}`, `{"series": ROWS}` or `{"look": STEP}`."""


_JSON = json.JSONEncoder(allow_nan=False, separators=(",", ":"))


def as_json(value: object, levels: int = 3) -> str:
    """Return an answer or a step as a page gets it. It is called where it is made, since a large one takes long. Maps
    are encoded entry by entry down to a message of a robot: meanwhile no other thread of Python goes on, so that a
    stop would wait for the end."""
    if levels == 0 or not isinstance(value, dict):
        return _JSON.encode(value)
    return (
        "{" + ",".join(f"{_JSON.encode(str(name))}:{as_json(each, levels - 1)}" for name, each in value.items()) + "}"
    )


class Questions:
    """Takes the questions of one page as they arrive. `run` until the page is gone."""

    def __init__(
        self,
        at_once: Callable[[Any], Awaitable[str]],
        in_turn: Callable[[Any], Awaitable[str]],
        send: Callable[[str], Awaitable[None]],
    ) -> None:
        """`at_once` answers a stop or its end, `in_turn` everything else, both as JSON; `send` sends a text to the
        page."""
        self._at_once = at_once
        self._in_turn = in_turn
        self._send = send
        self._waiting = asyncio.Queue[Any](MAX_WAITING)
        self._answers = asyncio.Queue[str](MAX_WAITING)

    async def take(self, asked: object) -> None:
        """Take a question. A stop, or its end, is given when this returns; everything else waits for its turn."""
        if is_halt(asked):
            self.tell(await self._at_once(asked))
            return
        try:
            self._waiting.put_nowait(asked)
        except asyncio.QueueFull:
            self.tell(as_json({"refused": f"{MAX_WAITING} others wait: try again when they are done"}))

    def tell(self, answer: str) -> None:
        """Send an answer to the page; it is lost where the page does not read its answers."""
        with contextlib.suppress(asyncio.QueueFull):
            self._answers.put_nowait(answer)

    async def run(self) -> None:
        """Answer questions in turn and send the answers."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._work())
            group.create_task(self._speak())

    async def _work(self) -> None:
        while True:
            await self._answers.put(await self._in_turn(await self._waiting.get()))

    async def _speak(self) -> None:
        while True:
            await self._send(await self._answers.get())


def is_halt(asked: object) -> bool:
    """Return whether a page asks for a stop or for its end. Both go the same way, so that the later one holds."""
    return isinstance(asked, dict) and isinstance(act := asked.get("do"), dict) and act.get("act") in ("stop", "arm")
