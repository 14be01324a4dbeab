"""README.md as an index of packages shows it: links and pictures lead to the release's files at the public address.

Hatchling runs this while it makes the metadata. Without `[project.urls] Repository` in pyproject.toml the text stays as
it is.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_RELATIVE = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)\s]+)\)")
"""A link, or with `!` a picture, whose target is a file of the repository."""


def absolute(text: str, repository: str, version: str) -> str:
    """Return Markdown whose relative links lead to the files of a version in the repository."""

    def lead(match: re.Match[str]) -> str:
        picture, words, target = match.groups()
        return f"{picture}[{words}]({repository}/{'raw' if picture else 'blob'}/v{version}/{target})"

    return _RELATIVE.sub(lead, text)


class Readme(MetadataHookInterface):
    """Sets the field `readme`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Read README.md, and make its links absolute where there is an address."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = metadata.get("urls", {}).get("Repository")
        if repository is not None:
            text = absolute(text, repository.rstrip("/"), metadata["version"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
