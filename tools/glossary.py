"""Hold the code to docs/reference/glossary.md: its terms name modules, and words that it replaced do not come back.

Run in the checkout by `./run check`. It prints each breach and exits with 1 if there is one.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("swarm", "services", "sim", "laptop")
PAGE = "docs/reference/glossary.md"
FEWEST_TERMS, FEWEST_MODULES = 60, 300
"""With fewer of them the check has not read what it should: a moved page or folder must not let everything pass."""

_PLAIN_WORDS = """
action actions answer answers app apps arguments ask automatic autoposition avoidance axis ballots battery before blink
block body bridge budget builder builtin bundle buses button buttons calibrate calls camera carried change changes check
checks checkup child choice claim claims clock collect collected column columns command commands completion configure
connection connections control core cut cuts data day days decision delays demo device devices discover display down
drive driver driving dump echo edges effects engines equipment errors estimation event events everyone examine example
exchange export external facts faults feed feedback fetch field fields figures file files film filters find fitting
flash flashing fleet flooding flow folder font footprint formation guard guide halt hand hang health hex history host
image import inbox info input install interface journal journeys key keys large layout leastsquares led leds level lie
limit limits line linear link links list listen live load loader localization localizer lock locked locks log logs look
main making map measure measurements message messages model module monitor motion move moving name names network new
noise note notes number numbered numbers on orders outbox packages packer packets pad page pair pairing param paths
periodic persistence physical picture pieces pipe pipeline place places plan play player playing plot plots plotting
poller port posture power process processes progress publisher quantities question questions radio ranging rates reader
record recorded recorder recording records register registers regulator remote replay report request requests restore
results robot robots roster round routing rules run runner runs samples scenario scene screen sections see send sender
senders serial series server service services session settings shapes shell show side sim simulated simulation
simulations slots sockets source space spec spectrum stand start state states status steps stop stopping storage store
stream style sub supervision surroundings survey switch system table tasks telemetry templates terminal terms text
texts threads time timeout times tool topics tracing track tracker traffic transfers trends trips tune types units unix
up values version versions view viewing wanted watch wire wiring wish world writer zero far manoeuvre spare calling
random experiments end percentile findings
"""
PLAIN = frozenset(_PLAIN_WORDS.split())
"""English words that mean in a module's name what they mean in English."""


def rows(text: str, heading: str) -> dict[str, str]:
    """Return the two-column table under `## heading`: its first column, in lower case, to its second."""
    section = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    found = re.findall(r"^\| ([^|]+?) \| ([^|]+?) \|$", section[1], re.M) if section else []
    return {name.strip("`").lower(): value for name, value in found[1:] if set(name) != {"-"}}


def words_of(name: str) -> set[str]:
    """Return the words of an identifier, in lower case: `sim_run`, `SimRun` and `SIM_RUN` are of `sim` and `run`."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+", name)}


def identifiers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of all that a module defines, imports or assigns."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.alias) and node.asname is not None:
            yield node.lineno, node.asname
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs | ast.MatchStar) and node.name is not None:
            yield node.lineno, node.name
        elif isinstance(node, ast.MatchMapping) and node.rest is not None:
            yield node.lineno, node.rest


def breaches(glossary: str, modules: dict[str, str]) -> list[str]:
    """Return what is wrong; `modules` maps paths within the tree to their source text."""
    terms, replaced = rows(glossary, "Terms"), rows(glossary, "Replaced words")
    found = []
    if len(terms) < FEWEST_TERMS or not replaced:
        found.append(f"{PAGE}: {len(terms)} terms and {len(replaced)} replaced words could be read: too few")
    if len(modules) < FEWEST_MODULES:
        found.append(f"{len(modules)} modules were found: too few")
    if list(terms) != sorted(terms):
        found.append(f"{PAGE}: the terms are not in alphabetical order")
    known = PLAIN.union(*map(words_of, terms))
    known |= {f"{word}s" for word in known}
    for path, source in sorted(modules.items()):
        for part in Path(path).with_suffix("").parts:
            for word in sorted(words_of(part) - known - {"init"}):
                found.append(f"{path}: {word!r} is neither a term of {PAGE} nor in tools/glossary.py")
            found += [f"{path}: {word!r} is now: {replaced[word]}" for word in words_of(part) & replaced.keys()]
        for line, name in identifiers(ast.parse(source)):
            for word in sorted(words_of(name) & replaced.keys()):
                found.append(f"{path}:{line}: {name}: {word!r} is now: {replaced[word]}")
    return found


def main() -> int:
    """Check the tree; return the exit code."""
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    modules = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in paths}
    found = breaches((ROOT / PAGE).read_text(encoding="utf-8"), modules)
    sys.stdout.writelines(f"{line}\n" for line in found)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
