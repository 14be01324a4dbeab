"""Edits of a robot's configuration files, as functions of their text: done twice they change nothing."""

import re
from collections.abc import Collection, Sequence

BEGIN = "# balboa-swarm: begin (swarm provision writes these lines)"
END = "# balboa-swarm: end"


def with_block(text: str, lines: Sequence[str]) -> str:
    """Return the text with our lines in a marked block at its end, in place of an older one.

    At the end, for in `config.txt` the last of two contradicting lines holds; `[all]` must be among `lines` there, or a
    section's filter before it would hold for ours, too.
    """
    begin, end = re.escape(BEGIN), re.escape(END)
    rest = re.sub(rf"(?ms)^{begin}\n(?:(?!^{begin}\n).)*?^{end}(?:\n|\Z)", "", text)
    if rest and not rest.endswith("\n"):
        rest += "\n"
    for stray in (BEGIN, END):  # they are left of a block that somebody has edited
        rest = re.sub(rf"(?m)^{re.escape(stray)}\n", "", rest)
    return "".join([rest, *(line + "\n" for line in (BEGIN, *lines, END))])


def with_words(text: str, add: Sequence[str], remove: Collection[str]) -> str:
    """Return the kernel's command line, which is one line, with these words, and without those that match `remove`."""
    words = [word for word in text.split() if word in add or not any(re.fullmatch(p, word) for p in remove)]
    words = list(dict.fromkeys(words))
    return " ".join([*words, *(word for word in add if word not in words)]) + "\n"


def with_setting(text: str, section: str, key: str, value: str) -> str:
    """Return an ini file (`/etc/bluetooth/main.conf`) with `key = value` in `[section]`.

    A line that sets it, or one that is commented out, is replaced; others of the section stay.
    """
    wanted = f"{key} = {value}"
    lines = text.splitlines()
    start = next((n for n, line in enumerate(lines) if line.strip() == f"[{section}]"), None)
    if start is None:
        return "".join(line + "\n" for line in (*lines, *([""] if lines else []), f"[{section}]", wanted))
    end = next((n for n in range(start + 1, len(lines)) if lines[n].lstrip().startswith("[")), len(lines))
    sets = [n for n in range(start + 1, end) if re.match(rf"\s*{re.escape(key)}\s*=", lines[n])]
    hints = [n for n in range(start + 1, end) if re.match(rf"\s*#\s*{re.escape(key)}\s*=", lines[n])]
    if sets:
        lines[sets[0]] = wanted
        for extra in reversed(sets[1:]):
            del lines[extra]
    elif hints:
        lines[hints[0]] = wanted
    else:
        lines.insert(start + 1, wanted)
    return "".join(line + "\n" for line in lines)


def with_host(text: str, name: str) -> str:
    """Return `/etc/hosts` with this robot's name at 127.0.1.1, as Debian has it."""
    lines = [line for line in text.splitlines() if not re.match(r"127\.0\.1\.1(\s|$)", line)]
    local = [n for n, line in enumerate(lines) if re.match(r"127\.0\.0\.1(\s|$)", line)]
    lines.insert(local[0] + 1 if local else 0, f"127.0.1.1\t{name}")
    return "".join(line + "\n" for line in lines)


def kernel_version(release: str) -> tuple[int, int]:
    """Return the version in a kernel's name: (6, 12) for 6.12.25+rpt-rpi-v8, (0, 0) where there is none."""
    match = re.match(r"(\d+)\.(\d+)", release)
    return (int(match[1]), int(match[2])) if match else (0, 0)
