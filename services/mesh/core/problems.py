"""What is wrong is worth a line in the log the first time only: neighbours may repeat it as often as they like."""

from services.mesh.core.node_actions import Note

MAX_NOTED = 256
"""Different problems logged; later new ones are only counted."""


class Problems:
    """Those that one node has met."""

    def __init__(self) -> None:
        self._noted: set[str] = set()

    def note(self, problem: str, text: str) -> tuple[Note, ...]:
        """The line for a problem; none where it has been met before."""
        if problem in self._noted or len(self._noted) >= MAX_NOTED:
            return ()
        self._noted.add(problem)
        return (Note(text, problem=True),)
