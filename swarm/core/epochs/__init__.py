"""The membership of a run: the agreement on its members and links, its notes, and what a robot knows of the others."""
