"""The lines of text that looks like Python: calls joined, strings unquoted, names of functions as those of tasks."""

from __future__ import annotations

import re
from collections.abc import Iterator

STRING = r'(?:[fFrRbBuU]{0,2}(?:"(?:[^"\\]|\\.)*+"|\'(?:[^\'\\]|\\.)*+\'))'
STRINGS = re.compile(STRING)
_LITERAL = re.compile(r'"(?:[^"\\]|\\.?)*+("|\Z)|\'(?:[^\'\\]|\\.?)*+(\'|\Z)')  # also one that is cut off
BRANCH = re.compile(r"(if|elif|while)\b\s*|(else)\s*:")
_ARGUMENT = re.compile(rf"(?:(\w+)\s*=\s*)?(?:({STRING}(?:[\s+]*{STRING})*)|([^\s,()\"'][^,()\"']*))\s*(?:,\s*)?")
_PRINTED = re.compile(r"\s*print\(\s*(\"|')(.*)\1\s*\)\s*;?")
_MOST_JOINED = 6  # lines of one statement


def arguments(code: str, at: int) -> tuple[list[str], dict[str, str], bool]:
    """The arguments of a call from where they begin: in order, by name, and whether none is cut off."""
    words, named = [], {}
    while match := _ARGUMENT.match(code, at):
        value = unquoted(match[2]) if match[2] else match[3].strip()
        if match[1]:
            named[match[1]] = value
        else:
            words.append(value)
        at = match.end()
    return words, named, code[at : at + 1] == ")" or (bool(words or named) and at == len(code))


def unquoted(strings: str) -> str:
    """The text of one or more string literals in a row."""
    parts = []
    for found in STRINGS.findall(strings):
        body = found.lstrip("fFrRbBuU")[1:-1]
        parts.append(re.sub(r"\\(.)", r"\1", body))
    return " ".join("".join(parts).split())


def task_name(name: str) -> str:
    """The task that a function is for: "door-lock", of "door_lock" and "DoorLock"."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", name).replace("_", "-").strip("-").lower() or "?"


def statements(text: str) -> Iterator[tuple[int, str]]:
    """The lines of a text, with their numbers; those of one call are joined, and what is printed is taken as it is."""
    lines = text.expandtabs(4).splitlines()
    at = 0
    while at < len(lines):
        line = lines[at]
        start = at
        if printed := _PRINTED.fullmatch(line):
            line = re.sub(r"\\(.)", r"\1", printed[2])
        at += 1
        if "check" in line or "robot." in line:
            while at < len(lines) and at - start < _MOST_JOINED and _depth(line) > 0 and not _begins(lines[at]):
                line += " " + lines[at].strip()
                at += 1
        yield start + 1, line


def _begins(line: str) -> bool:
    """Whether a line begins a statement of its own."""
    code = line.strip()
    return not code or code.startswith(("#", "```", "def ", "robot.")) or BRANCH.match(code) is not None


def is_cut(code: str) -> bool:
    """Whether a string that begins in a line does not end in it, or a condition has no end."""
    found = bare(code)
    return '"' in found or not found.rstrip().endswith(":")


def _depth(line: str) -> int:
    """How many parentheses are open at the end of a line; 0 if a string is."""
    found = bare(line)
    return 0 if '"' in found else found.count("(") - found.count(")")


def bare(code: str) -> str:
    """A line without its strings and its comment; of a string that is cut off a quote is left."""
    return _LITERAL.sub(lambda found: "" if found[1] or found[2] else '"', code).partition("#")[0]
