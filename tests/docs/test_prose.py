"""Pages and help texts keep to what a program can see of plain language.

No line is over 120 characters but rows of tables, which cannot be broken, and bytes and output that stand as they are
printed. Sentences are short, also those in tables, phrases that hide who does what are not used, every picture has a
text for those who do not see it, and pages to be read in one go are short.
"""

import ast
import functools
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [page for folder in ("docs", ".github", "firmware") for page in (ROOT / folder).rglob("*.md")]
    + [*ROOT.glob("*.md")]
)
WIDTH = 120
MOST_WORDS_OF_A_PAGE = 1200
"""Of a page that is read from its beginning to its end, code left out. Reference pages are looked into."""
MOST_WORDS_OF_A_SENTENCE = 32
BANNED = re.compile(
    r"\A(?:Who|Whose|What) (?![^?]*\?\Z)(?=.*\.\Z)|"
    r"\b(?:be it|while which|(?:is|are) (?:told|said)|as the thing has it|whoever|who waits|to and fro|all else)\b",
    re.IGNORECASE,
)
"""Phrases without a subject that can be pointed at, and old-fashioned ones."""


AS_PRINTED = re.compile(r" *(?:[\w-]+ +)?(?:[0-9a-f]{2} ){8}|(?:\S.*? {2,}){5}| {4}problem ")
"""Lines that cannot be broken: bytes in hex, the rows of a printed table, and an error as the command prints it."""


def breakable(text: str) -> Iterator[tuple[int, str]]:
    """Lines that a writer can break, with their numbers: prose, commands and code."""
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("|") and not AS_PRINTED.match(line):
            yield number, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_of_a_page_fit(page: Path) -> None:
    long = [number for number, line in breakable(page.read_text(encoding="utf-8")) if len(line) > WIDTH]
    assert long == [], f"{page.relative_to(ROOT)}: lines over {WIDTH} characters"


def test_the_checks_of_prose_find_the_pages() -> None:
    assert len(PAGES) > 35


NOTE = re.compile(r'^(?:!!!|\?\?\?)\+? \w+(?: "(.*)")?\n((?: {4}.*\n|\n)*)', re.MULTILINE)
"""A note of a page: its title, and its text, which is indented as code would be."""


def sentences(text: str) -> Iterator[str]:
    """Sentences of a page's prose, notes, lists and tables, with code and the targets of links left out."""
    text = re.sub(r"^( *)```.*?^ *```$", "\n\n", text, flags=re.MULTILINE | re.DOTALL)
    text = NOTE.sub(lambda note: f"{note[1] or ''}\n\n{textwrap.dedent(note[2])}\n", text)
    paragraphs: list[list[str]] = [[]]
    inside = False
    for line in text.splitlines():
        item = re.match(r"\s*([-*]|\d+\.) (.*)", line)
        inside = bool(item) or (inside and line.startswith(" "))
        if line.startswith("|"):
            paragraphs += [[cell.strip()] for cell in re.split(r"(?<!\\)\|", line)]
        elif not line.strip() or item or line.startswith(("#", "<!--")) or (line[:4].isspace() and not inside):
            paragraphs.append([item[2]] if item else [])
        else:
            paragraphs[-1].append(line.strip())
    for paragraph in map(" ".join, paragraphs):
        yield from sentences_of(re.sub(r"`[^`]*`", "code", re.sub(r"\]\([^)]*\)", "]", paragraph)))


def sentences_of(plain: str) -> Iterator[str]:
    """Parts of a text without marks that each begin with a capital letter, or follow a semicolon."""
    yield from filter(None, re.split(r"(?<=[.!?:])[\s*_)\"]+(?=[A-Z\[*(c])|; ", plain))


def faults(sentence: str) -> list[str]:
    """What is wrong with a sentence."""
    count = len(sentence.split())
    long = [f"{count} words: {sentence}"] if count > MOST_WORDS_OF_A_SENTENCE else []
    return long + [f"{phrase[0]!r}: {sentence}" for phrase in BANNED.finditer(sentence)]


def breaches(page: Path) -> list[str]:
    """What a page's sentences do wrong."""
    return [fault for sentence in sentences(page.read_text(encoding="utf-8")) for fault in faults(sentence)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_sentences_are_short_and_plain(page: Path) -> None:
    found = breaches(page)
    assert not found, "\n".join([str(page.relative_to(ROOT)), *found])


def wording(node: ast.expr) -> str:
    """The text of a literal, with a word for each value that is put in; empty for any other expression."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(wording(part) or "value" for part in node.values)
    return wording(node.left) + wording(node.right) if isinstance(node, ast.BinOp) else ""


def texts(module: Path) -> Iterator[str]:
    """The texts for people in a module's code: the help of its commands and options, and the words of its errors."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield from (wording(each.value) for each in node.keywords if each.arg in ("help", "description", "epilog"))
        elif isinstance(node, ast.Assign) and any(
            ast.unparse(name).endswith(("HELP", "DESCRIPTION")) for name in node.targets
        ):
            yield wording(node.value)
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            yield from map(wording, node.exc.args)


@pytest.mark.parametrize("package", ["swarm", "services", "sim", "laptop"])
def test_help_and_errors_are_short_and_plain(package: str) -> None:
    found = [
        f"{module.relative_to(ROOT)}: {fault}"
        for module in sorted((ROOT / package).rglob("*.py"))
        for text in texts(module)
        for sentence in sentences_of(" ".join(text.split()))
        for fault in faults(sentence)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pictures_of_a_page_have_a_text_in_their_place(page: Path) -> None:
    shown = re.findall(r"!\[([^]]*)\]\(", page.read_text(encoding="utf-8"))
    assert [text for text in shown if len(text.split()) < 3] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_that_is_read_in_one_go_is_short(page: Path) -> None:
    name = page.relative_to(ROOT)
    if name.parts[0] != "docs" or name.parts[1] == "reference":
        return
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    count = len(re.findall(r"[^\s|]+", text))
    assert count <= MOST_WORDS_OF_A_PAGE, f"{name} has {count} words: split it, or move facts into a reference page"


def test_notes_and_modules_helps_are_read(tmp_path: Path) -> None:
    page, module = tmp_path / "page.md", tmp_path / "command.py"
    page.write_text(
        'Before.\n\n!!! note "Whoever reads"\n    Whoever comes.\n\n    Whoever goes.\n\n        whoever is code\n'
    )
    assert [fault.partition(": ")[2] for fault in breaches(page)] == [
        "Whoever reads",
        "Whoever comes.",
        "Whoever goes.",
    ]
    module.write_text('HELP = "greet whoever comes"\n')
    assert list(texts(module)) == ["greet whoever comes"]


def test_what_the_rules_are_about_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    long = f"A short one: {'word ' * 33}end."
    page.write_text(f"# Title\n\n{long} Whoever waits [comes](whoever.md) back.\nWhat is this? What is refused goes.\n")
    assert [line.partition(":")[0] for line in breaches(page)] == ["37 words", "'Whoever'", "'What '"]


NAMED_FILE = re.compile(r"`((?:[\w-]+/)+[\w-]+\.(?:py|cpp|js))`")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_source_files_that_a_page_names_exist(page: Path) -> None:
    """A path may leave out its first folders where the page has named them before."""
    named = set(NAMED_FILE.findall(page.read_text(encoding="utf-8")))
    assert [name for name in sorted(named) if not any(path.endswith(f"/{name}") for path in sources())] == []


@functools.cache
def sources() -> tuple[str, ...]:
    folders = ("bench", "deploy", "examples", "firmware", "lab", "laptop", "services", "sim", "swarm", "tests", "tools")
    found = (path for folder in folders for path in (ROOT / folder).rglob("*.*"))
    return tuple(f"/{path.relative_to(ROOT)}" for path in found if path.suffix in (".py", ".cpp", ".js"))
