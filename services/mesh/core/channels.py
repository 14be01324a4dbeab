"""Channel handles: a key's text crosses a connection once, afterwards two bytes stand for it."""

from collections import OrderedDict

from services.mesh.core.frames import MAX_CHANNELS


class Channels:
    """Our handles for the keys we send on one connection; the least recently used one is bound anew when all
    are taken."""

    def __init__(self, size: int = MAX_CHANNELS) -> None:
        self._size = size
        self._handles: OrderedDict[str, int] = OrderedDict()

    def handle(self, key: str) -> tuple[int, bool]:
        """The handle of `key`, and whether the other end must be told of it first."""
        handle = self._handles.get(key)
        if handle is not None:
            self._handles.move_to_end(key)
            return handle, False
        handle = len(self._handles) if len(self._handles) < self._size else self._handles.popitem(last=False)[1]
        self._handles[key] = handle
        return handle, True
