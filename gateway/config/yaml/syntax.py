"""Mistakes in the form of a YAML file, as sentences: tabs, colons, quotes, marks of a merge."""

import re
from collections.abc import Iterator
from itertools import islice
from typing import Any

import yaml

DEEPEST = 50  # levels; a configuration has less than ten
TOO_DEEP = f"more than {DEEPEST} levels deep: look for a bracket or a dash too many"
_REMEDIES = {
    "escape character": "in double quotes a backslash begins an escape: use single quotes",
    "quoted scalar": "close the quote",
    "mapping values": "check indentation and colons of this line and the one before, "
    "and put a text with `: ` in it in quotes",
    "simple key": "check indentation and colons of this line and the one before",
    "parsing a block": "check the indentation of this line and the one before",
    "parsing a flow": "check commas and brackets, "
    "and put a text with one of , : [ ] { } # in it in quotes",
    "scanning": "put a text that begins with one of % @ ` & * ! | > in quotes",
}
# One slip of the hand in a line that YAML does not understand, and what is right.
_CONFLICT = re.compile(r"(<{7}|={7}|>{7}|\|{7})(?: |\Z)")
_NO_SPACE = re.compile(r"\s*(?:- )?(\w[\w./-]{0,99}):([^\s/:].{0,99})\Z")
_NO_COLON = re.compile(r"\s*(\w[\w./-]{0,99})(?: +=?| *\Z)([^:#]{0,99}|[\[{].{0,99})\Z")


def syntax_mistake(name: str, text: str, error: yaml.MarkedYAMLError) -> str:
    """Returns the place of a mistake, and a sentence with what is right."""
    mark = error.problem_mark or error.context_mark
    line = line_of(mark) if mark else 1
    problem = error.problem or "not understood"
    rows = text.splitlines()
    row = rows[line - 1] if line <= len(rows) else ""
    if "\t" in row[: len(row) - len(row.lstrip(" \t-"))]:
        return f"{name}:{line}: a tab: YAML is indented with spaces"
    if problem == "but found another document":
        return f"{name}:{line}: a second document (`---`): a configuration is one document"
    if problem.startswith("found undefined alias"):
        return f"{name}:{line}: an alias (*) without its anchor (&) before it"
    if problem == TOO_DEEP:
        return f"{name}:{line}: {problem}"
    if slip := next(filter(None, (_slip(rows, near) for near in _near(error, line))), None):
        return f"{name}:{slip}"
    context = error.context or ""
    begun = ""
    if error.context_mark and line_of(error.context_mark) != line:
        begun = f" that begins in line {line_of(error.context_mark)}"
    message = f"{context}{begun}, {problem}" if context else problem
    remedies = (remedy for word, remedy in _REMEDIES.items() if word in message)
    return f"{name}:{line}: no YAML: {': '.join([message, *islice(remedies, 1)])}"


def _near(error: yaml.MarkedYAMLError, line: int) -> Iterator[int]:
    """Yields the lines in which the cause of a mistake may be; the likely ones first."""
    begun = line_of(error.context_mark) if error.context_mark else line
    yield from dict.fromkeys((begun, line - 1, line) if begun != line else (line - 1, line))


def _slip(rows: list[str], line: int) -> str:
    """Returns the line and what is wrong in it; empty for a line without a known slip."""
    row = rows[line - 1] if 0 < line <= len(rows) else ""
    if match := _CONFLICT.match(row):
        return f"{line}: {match[1]} is a mark of a merge conflict: keep one of the two versions"
    if "\xa0" in row:
        return f"{line}: a no-break space, as web pages and Word have it: write a plain space"
    if match := _NO_SPACE.match(row):
        return f"{line}: no space after a colon: write {match[1]}: {match[2]}"
    if match := _NO_COLON.match(row):
        return f"{line}: no colon after {match[1]}: write {match[1]}: {match[2].strip()}".strip()
    return ""


def line_of(mark: Any) -> int:
    return int(mark.line) + 1
