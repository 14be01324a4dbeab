"""Channel handles: a key's text crosses a connection once, afterwards two bytes stand for it."""

from collections import OrderedDict

from services.mesh.core.frames import MAX_CHANNELS, NEIGHBOURS


def name_of(overlay: int, key: str) -> str:
    """What a channel is called on our side: the key, in front of it the overlay's digit unless it is `neighbours`.
    Keys begin with a letter."""
    return key if overlay == NEIGHBOURS else f"{overlay}{key}"


def overlay_of(name: str) -> tuple[int, str]:
    """Overlay and key of a channel."""
    return (int(name[0]), name[1:]) if name[0].isdigit() else (NEIGHBOURS, name)


class Channels:
    """Our handles for the keys we send on one connection; the least recently used one is bound anew when all
    are taken."""

    __slots__ = (
        "_handles",
        "_size",
    )

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
