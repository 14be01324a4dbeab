"""The DWM1001's shell mode, which is for people: lines of text at the same 115200 baud.

Two carriage returns within a second enter it, `quit` leaves it. There is no binary traffic in this mode: what
a robot's service sends is taken for typing. A service that finds its module there sends `LEAVE`.
"""

LEAVE = b"quit\r"
LEAVE_TIMES = 2
"""How many times `quit` is sent. The module has taken binary requests for typing, so the first `quit` ends an unknown
command."""
PROMPT = b"dwm>"
