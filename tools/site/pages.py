"""Pages of the documentation site that are made from the code, and links that leave the folder of the docs.

MkDocs calls these functions while it builds the site (`hooks` of mkdocs.yml). The command line's page comes from the
commands' own help, that of swarm.toml from `swarm config --example`, so neither can tell what is no longer so.
"""

import contextlib
import io
import os
import posixpath
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from laptop.cli.commands import SECTIONS
from swarm import __version__
from swarm.config.example import EXAMPLE
from swarm.onboard.command_line import Command, CommandGroup, parser_of

ROOT = Path(__file__).parents[2]
PROJECT = ROOT / "pyproject.toml"
WIDTH = "84"
"""Columns of the help texts."""
ELSEWHERE = {"firmware/README.md": "reference/firmware.md"}
"""Pages of the site by the files outside of the docs from which they are made, as paths in the checkout."""
_FENCE = re.compile(r"^```(\w+) (?:([\w./]+\.\w+)|.*)$", re.MULTILINE)
"""A code block's language, and the name of a file or how tests run it, which Markdown's extension knows nothing of."""
_LINK = re.compile(r"\]\((\.\./[^)#\s]+)(#[^)\s]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Show the version on every page, and in the footer the address of the source where pyproject.toml has one.

    A `repo_url` would do that too, but then each page asks the host of the source for its stars.
    """
    config.site_name = f"Balboa Swarm {__version__}"
    urls = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["urls"]
    config.site_url = urls.get("Documentation")
    if "Repository" in urls:
        config.extra["social"] = [{"icon": "fontawesome/brands/git-alt", "link": urls["Repository"], "name": "Source"}]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made."""
    os.environ["COLUMNS"] = WIDTH
    made = {
        "reference/commands.md": commands_page(),
        "reference/configuration.md": configuration_page(),
        "reference/firmware.md": firmware_page(),
    }
    for path in sorted((ROOT / "examples").glob("*.py")):
        made[f"examples/{path.stem}.md"] = example_page(path)
    for name, text in made.items():
        file = File.generated(config, name, content=text)
        if name.startswith("examples/"):
            file.inclusion = file.inclusion.NOT_IN_NAV
        files.append(file)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links to files beside the docs lead to the pages made of them, and blocks show the names of their files."""
    folder = posixpath.dirname(f"docs/{page.file.src_uri}")

    def lead(match: re.Match[str]) -> str:
        target, anchor = posixpath.normpath(posixpath.join(folder, match[1])), match[2] or ""
        name = ELSEWHERE.get(target)
        if name is None and target.startswith("examples/") and target.endswith(".py"):
            name = f"examples/{Path(target).stem}.md"
        return match[0] if name is None else f"]({posixpath.relpath(f'docs/{name}', folder)}{anchor})"

    def title(match: re.Match[str]) -> str:
        return f"```{match[1]}" + (f' title="{match[2]}"' if match[2] else "")

    return _LINK.sub(lead, _FENCE.sub(title, markdown))


def commands_page() -> str:
    """All commands with their help."""
    lines = ["# Command line", "", "Every command lists its arguments with `--help`. This page shows these texts."]
    for title, section in SECTIONS.items():
        lines += ["", f"## {title[:1].upper()}{title[1:]}"]
        for name, each in section.items():
            if isinstance(each, CommandGroup):
                lines += ["", f"### swarm {name}", "", f"{each.help}."]
                for sub, command in each.commands.items():
                    lines += _command(f"{name} {sub}", command, "####")
            else:
                lines += _command(name, each, "###")
    return "\n".join([*lines, ""])


def _command(name: str, command: Command, heading: str) -> list[str]:
    return ["", f"{heading} swarm {name} {{ #{name.replace(' ', '-')} }}", "", *_fenced(_help_text(name, command))]


def _help_text(name: str, command: Command) -> str:
    try:
        parser = parser_of(name, command)
    except AttributeError:  # a program of its own
        words = [sys.executable, "-P", "-m", "laptop.cli", *name.split(), "--help"]
        return subprocess.run(words, check=True, capture_output=True, text=True).stdout.strip()
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        parser.parse_args([*command.first, "--help"])
    return out.getvalue().strip()


def _fenced(text: str, language: str = "text") -> list[str]:
    return [f"```{language}", *text.splitlines(), "```"]


def configuration_page() -> str:
    """One file describes the whole swarm: the commented example."""
    return "\n".join(
        [
            "# swarm.toml",
            "",
            "One file describes the whole swarm. `swarm config --example` prints this, with every setting, its default",
            "and what it means; `swarm config check FILE` names what is wrong with a file, and where.",
            "",
            *_fenced(EXAMPLE, "toml"),
            "",
        ]
    )


def firmware_page() -> str:
    """The firmware's own page; what it names in its folder stays a name."""
    text = (ROOT / "firmware" / "README.md").read_text(encoding="utf-8")
    text = text.replace("](../docs/", "](../")
    return re.sub(r"\[([^\]]+)\]\((?!\.\./|#|http)[^)]+\)", r"\1", text)


def example_page(path: Path) -> str:
    """The source of an example."""
    return "\n".join([f"# {path.name}", "", *_fenced(path.read_text(encoding="utf-8"), "python"), ""])
