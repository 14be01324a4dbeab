"""The error text about a robot whose answer is not what our programs give."""

from swarm.errors import RemoteError
from swarm.process.text import printable

MISUNDERSTOOD = (RemoteError, LookupError, ValueError, TypeError, AttributeError, RecursionError)
"""The errors that code may raise when it decodes such an answer."""


def misunderstood(error: BaseException) -> str:
    """Describe an answer that cannot be understood: the robot's release may be another one, or the robot is not ours
    any more. No other robot is harmed by it."""
    return f"its answer cannot be understood: {type(error).__name__}: {printable(str(error))}"
