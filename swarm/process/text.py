"""Text that others have named, made safe to show: reasons, field names, names of apps, lines of logs.

Written as it is, such text can steer a terminal (ESC), forge lines (newline) or reverse what is read (bidi overrides).
`swarm.process.log` and `swarm.process.terminal` call this for everything that a process of ours writes.
"""

from swarm.errors import cut

LONGEST = 200
"""Characters of a text within a sentence."""

_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}


def printable(text: str, longest: int | None = LONGEST) -> str:
    r"""Return `text` as one line of at most `longest` visible characters (None: no limit), at least three.

    Every character that is not visible (a control character, a line break, a direction mark, half a surrogate pair) is
    written as JSON writes it, `\u001b`, so that a line of JSON means what it meant.
    """
    # Cut before anything is made longer: the text may be a megabyte.
    shown = text if longest is None else text[: longest + 1]
    if not shown.isprintable():
        shown = "".join(map(_letter, shown))
    return shown if longest is None else cut(shown, longest)


def _letter(letter: str) -> str:
    if letter.isprintable():
        return letter
    code = ord(letter)
    if code < 0x10000:
        return _SHORT.get(letter) or f"\\u{code:04x}"
    high, low = divmod(code - 0x10000, 0x400)  # two halves, as JSON has it
    return f"\\u{0xD800 + high:04x}\\u{0xDC00 + low:04x}"
