"""Channel handles: a key's text crosses a connection once, afterwards two bytes stand for it."""

from services.mesh.core.wire.frames import MAX_CHANNELS, NEIGHBOURS


def name_of(overlay: int, key: str) -> str:
    """What a channel is called on our side: the key, in front of it the overlay's digit unless it is `neighbours`.
    Keys begin with a letter."""
    return key if overlay == NEIGHBOURS else f"{overlay}{key}"


def overlay_of(name: str) -> tuple[int, str]:
    """Overlay and key of a channel."""
    return (int(name[0]), name[1:]) if name[0].isdigit() else (NEIGHBOURS, name)


class Channels:
    """Our handles for the keys we send on one connection; when all are taken, the least recently used one is bound
    anew. Until then nobody looks who was used when."""

    __slots__ = (
        "_handles",
        "_size",
    )

    def __init__(self, size: int = MAX_CHANNELS) -> None:
        self._size = size
        self._handles: dict[str, int] = {}

    def handle(self, key: str) -> tuple[int, bool]:
        """The handle of `key`, and whether the other end must be told of it first."""
        handles = self._handles
        handle = handles.get(key)
        if handle is None:
            handle = len(handles) if len(handles) < self._size else handles.pop(next(iter(handles)))
            handles[key] = handle
            return handle, True
        if len(handles) == self._size:
            handles[key] = handles.pop(key)
        return handle, False
