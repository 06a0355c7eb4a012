"""Labels in prose, for the parts of a rule ("Condition:", "Action:") and for notes ("Constraints:")."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from lw_torchrl._util.checks import shown
from lw_torchrl.language.formats.base import PROGRAM_WORDS, Note
from lw_torchrl.language.formats.markup import BULLET, WHEN, rule_sentence
from lw_torchrl.language.formats.phrases import is_command, plain, role_of

_LABEL = re.compile(
    r"(?P<mark>[*_`]{0,3})(?P<label>[A-Za-z][A-Za-z0-9 ]{0,24}?)[*_`]{0,3}(?: ?:| [-–—])[*_`]{0,3}(?=\s|$)\s*"
)
_CUT = re.compile(
    rf"\s*(?:[.;,|→]|[-=]+>|(?=\s[*_]))\s*(?={_LABEL.pattern})".replace("?P<mark>", "?:").replace("?P<label>", "?:")
)
_TITLE = re.compile(r"[\s#*]*(?:(?:step|stage|phase|rule)? ?\d+[.:)]*)?[\s*–—-]*(\w.*?)[\s:.*]*", re.IGNORECASE)
_KEY = re.compile(r"\s*(?:- )?[\w -]{1,40}:\s*")
_ASIDE = re.compile(
    r"\s*(?:(?P<mark>[#*_]+)\s*|(?=[A-Z]))(?:\w+ ){0,2}?"
    rf"(?i:(?P<aside>{'|'.join(PROGRAM_WORDS['prose']['asides'])})|rules|requirements|guidelines|important)\b"
    r"(?: (?:and|for|on) [\w ]{1,30})?"
    r"[*_]*(?::[*_]*\s*(?P<rest>.*)|(?<=[\w*_])\s*$(?(mark)|(?!)))"
)
_NEXT_LABEL = re.compile(r"\s*(?:#|[*_]{2}[^*_]+[*_]{2}:?\s*$|[A-Z][\w ]{0,40}:\s*$)")
_RULE = re.compile(r"\b(?:when|whenever|if|once|unless|while)\b|[→⇒]|[-=]>", re.IGNORECASE)
_PARTS = {"test": "test", "unless": "test", "act": "act", "until": "act", "else": "else"}
_JOINTS = {"test": " and ", "unless": " and ", "act": ", then ", "until": " until ", "else": ", then "}
_ASIDES = ("comment", "name")


@dataclass
class _Rule:
    """A rule, and how its labels are written."""

    parts: dict[str, str] = field(default_factory=dict)  # the texts by part ("test", "act" or "else")
    lines: dict[int, str] = field(default_factory=dict)  # the last part in each line, by line number
    above: int = -1  # number of the line above the rule
    is_marked: bool = False  # whether its labels cannot be keys in YAML
    places: set[tuple[str, int, int]] = field(default_factory=set)  # bullet, indent, and number of the line above

    @property
    def is_complete(self) -> bool:
        """Whether the rule has a condition and an action."""
        return bool(self.parts.get("test") and self.parts.get("act"))


def without_asides(text: str, notes: list[Note]) -> str:
    """Remove notes and constraints with their labels if a rule remains. Append a note on each line; keep line numbers.

    A list below "Rules:" is also removed if the list has no condition and other rules precede it.

    Example:
        >>> without_asides("If the gripper is open, close it.\\n\\nNote: close it slowly.", notes := []).strip()
        'If the gripper is open, close it.'
        >>> print(*notes)
        line 3: 'Note: close it slowly.' is left out: it is not part of the plan
    """
    lines = text.splitlines()
    removed, at = set[int](), 0
    first_rule = next((number for number, line in enumerate(lines) if _RULE.search(line)), len(lines))
    while at < len(lines):
        label, start, at = _ASIDE.match(lines[at]), at, at + 1
        if label is None:
            continue
        if not label["rest"]:
            while at < len(lines) and not lines[at].strip():
                at += 1
            is_below = at == start + 1 or label["mark"] or BULLET.match(lines[at] if at < len(lines) else "")
            while is_below and at < len(lines) and lines[at].strip() and not _NEXT_LABEL.match(lines[at]):
                at += 1
        if label["aside"] or (first_rule < start and not any(map(_RULE.search, lines[start:at]))):
            removed.update(number for number in range(start, at) if lines[number].strip())
    has_rule = any(_RULE.search(line) for number, line in enumerate(lines) if number not in removed)
    if not removed or not has_rule:
        return text
    for number in sorted(removed):
        notes.append(Note(number + 1, f"{shown(lines[number].strip())} is left out: it is not part of the plan"))
        lines[number] = ""
    return "\n".join(lines)


def labelled_rules(text: str) -> str:
    """Rewrite each rule whose condition and action have labels as a sentence. The number of lines stays the same.

    Keys in YAML look like these labels, so labels without emphasis or a number only count if they repeat.

    Example:
        >>> print(labelled_rules("**Condition:** the gripper is open\\n**Action:** close the gripper").strip())
        - When the gripper is open, the robot should close the gripper.
    """
    lines = text.splitlines()
    rules = list(_rules(lines))
    counts = Counter(place for each in rules for place in each.places)

    def may_be_yaml(rule: _Rule) -> bool:
        (bullet, indent, above), *others = sorted(rule.places)
        key = _KEY.fullmatch(lines[above]) if bullet and above >= 0 else None
        is_single = counts[bullet, indent, above] < 2 and (key is not None or not bullet)
        is_sequence = key is not None and role_of(key[0].strip(" -:")) == "sequence"
        return bool(others or is_single or is_sequence or (indent and not bullet))

    is_yaml = any(not each.is_marked and may_be_yaml(each) for each in rules)
    for each in rules:
        if is_yaml and not each.is_marked:
            continue
        indent = min(each.places, key=lambda place: place[:1])[1]
        title = _TITLE.fullmatch(lines[each.above]) if each.above >= 0 else None
        if title is not None and " " in title[1] and is_command(title[1]):
            lines[each.above] = ""  # "Step 1: Approach the puck"
        for number in each.lines:
            lines[number] = ""
        written = {part: number for number, part in each.lines.items()}
        if "else" in written:
            lines[written.pop("else")] = " " * indent + f"- Otherwise, {each.parts['else']}."
        lines[max(written.values())] = " " * indent + rule_sentence(each.parts["test"], each.parts["act"])
    return "\n".join(lines) if rules else text


def _rules(lines: list[str]) -> Iterator[_Rule]:
    """Yield the rules whose parts have labels."""
    rule, first, last, above, document, is_near = _Rule(), "", "", -1, -1, True
    for number, line in enumerate([*lines, "#"]):
        fields = _fields(line)
        roles = {role for role, *_ in fields}
        if roles and roles <= {*_ASIDES}:
            continue
        for role, value, is_marked in fields:
            if role in _ASIDES:
                continue
            part = _PARTS[role]
            first = first or part
            is_next = part == first and {*rule.parts} - {first}
            if is_next or (rule.is_complete and not is_near):
                if rule.is_complete:
                    yield rule
                rule = _Rule()
            value = f"({value})" if part == "test" and " or " in value else value
            value = f"not ({value})" if role == "unless" else value
            rule.parts[part] = f"{rule.parts[part]}{_JOINTS[role]}{value}" if part in rule.parts else value
            bullet = BULLET.match(line)
            is_numbered = above >= 0 and re.match(r"\s*(?:\W?\d|\*\*)", lines[above])
            rule.above, rule.is_marked = above, bool(rule.is_marked or is_marked or is_numbered)
            rule.places.add(("-" if bullet else "", len(line) - len(line.lstrip()), above if bullet else document))
            rule.lines[number] = last = part
            is_near = True
        if not line.strip():
            is_near = False
        elif (
            not fields
            and number - 1 in rule.lines
            and re.match(r"\s*[a-z](?!\))", line)
            and rule.parts[last][-1:] != "."
        ):
            rule.parts[last] = f"{rule.parts[last]} {line.strip()}".strip()
            rule.lines[number] = last
        elif not fields:
            if rule.is_complete:
                yield rule
            rule, above = _Rule(), number
            document = number if line.startswith("---") else document


def _fields(line: str) -> list[tuple[str, str, bool]]:
    """Return (role, value, whether it cannot be YAML) for each label in a line; [] if the line has other text."""
    bullet, fields = BULLET.match(line), list[tuple[str, str, bool]]()
    pieces = _CUT.split(line[bullet.end() :] if bullet else line.lstrip())
    for piece in pieces:
        label = _LABEL.match(piece)
        role = role_of(label["label"]) if label else ""
        value = piece[label.end() :].strip(" *_`") if label else ""
        is_sentence = role == "act" and WHEN.match(value) is not None
        if label is None or role not in (*_PARTS, *_ASIDES) or is_sentence or value.endswith("?"):
            return []
        if plain(label["label"]) in ("elif", "else if", "elseif"):
            value = f"otherwise, if {value}"
        fields.append((role, value, bool(label["mark"] or len(pieces) > 1 or re.match(r"\s*\W?\d", line))))
    return fields
