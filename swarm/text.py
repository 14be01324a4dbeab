"""Text that others have named, made safe to show: reasons, field names, names of apps, lines of logs.

Written as it is, such text can steer a terminal (ESC), forge lines (newline) or reverse what is read (bidi overrides).
`swarm.log` and `swarm.terminal` call this for everything that a process of ours writes.
"""

LONGEST = 200
"""Characters of a text within a sentence."""


def printable(text: str, longest: int | None = LONGEST) -> str:
    """One line of at most `longest` visible characters (None: as many as there are).

    Every character that is none (a control character, a line break, a direction mark, half a surrogate pair) is written
    as JSON writes it, `\\u001b`, so that JSON stays the JSON it was.
    """
    if longest is not None and len(text) > longest:
        # Cut before anything is made longer: the text may be a megabyte.
        return _shown(text[:longest])[: max(0, longest - 3)] + "..."[:longest]
    shown = _shown(text)
    return shown if longest is None or len(shown) <= longest else shown[: max(0, longest - 3)] + "..."[:longest]


def _shown(text: str) -> str:
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else _escape(ord(letter)) for letter in text)


def _escape(code: int) -> str:
    if code < 0x10000:
        return f"\\u{code:04x}"
    high, low = divmod(code - 0x10000, 0x400)  # as JSON does: two halves
    return f"\\u{0xD800 + high:04x}\\u{0xDC00 + low:04x}"
