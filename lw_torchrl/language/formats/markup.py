"""Rewrite tables of rules as sentences, and find the rules in a line."""

from __future__ import annotations

import re
from collections.abc import Iterator

from lw_torchrl.language.formats.base import PROGRAM_WORDS
from lw_torchrl.language.formats.phrases import is_noun

_LONGEST = 2_000  # maximum length of a line to read (characters), to bound the time
BULLET = re.compile(r"\s*(?:[-*•–+>①-⑳]|\(?\[?\d{1,3}[.)\]]|[a-z]\))\s+")
WHEN = re.compile(
    r"(?:<[^<>]*>|[\"'`*]|#+ )*(?:(?:finally|then|next|first|lastly|and|or|else),?\s+)?"
    r"(when|whenever|if|once|while|as long as|as soon as|after)\s+(.+)",
    re.IGNORECASE,
)
_CONDITION = r"(?:conditions?|when|if|trigger|state|situation|guard|precondition|case)"
_ACTION = r"(?:actions?|do|then|skill|the robot should|robot|behaviou?r|response|what to do|command|perform)"
_SENTENCE = re.compile(
    r"(?<=[.;!?])\s+(?:and\s+)?(?:\(?\w{1,2}[.)]\s+)?"
    r"(?=(?:(?:then|and|finally|next|otherwise),?\s+)?(?:when|whenever|if|once|as soon as)\b[^.;!?]*?,\s)",
    re.IGNORECASE,
)
_ROWS = re.compile(  # of tables in HTML and in reStructuredText
    r"<tr[^>]*>\s*<td[^>]*>(.*?)</td>\s*<td[^>]*>(.*?)</td>.*?</tr>|^[ \t]*\* - ([^\n]+)\n[ \t]+- ([^\n]+)$",
    re.DOTALL | re.MULTILINE | re.IGNORECASE,
)


def table_rules(text: str) -> str:
    """Rewrite each row of a table of rules as a sentence, and each item of an HTML list as a line.

    Example:
        >>> print(table_rules("| the gripper is open | `close the gripper` |"))
        - When the gripper is open, the robot should close the gripper.
    """
    text = re.sub(r"(?<=\S)[ \t]*<li\b", "\n<li", re.sub(r"</?[ou]l\b[^>]*>|</li>", "", text))
    text = re.sub(r"^[ \t]*<li\b[^>]*>[ \t]*", "- ", text, flags=re.MULTILINE)
    text = _ROWS.sub(
        lambda row: "\n" * row[0].count("\n") + f"\n{rule_sentence(row[1] or row[3], row[2] or row[4])} ", text
    )
    lines = text.splitlines()
    if max(map(len, lines), default=0) > _LONGEST:
        return text
    _tables(lines)
    return "\n".join(lines)


def sentences(line: str) -> Iterator[str]:
    """Yield the rules in a line: "When A, do B. When C, do D." contains two."""
    if len(line) > _LONGEST:
        yield line
        return
    bullet = BULLET.match(line)
    first, *others = _SENTENCE.split(line)
    if not _is_rule(first) and len(others) < 2:
        first, others = line, []
    if not others and (joined := re.fullmatch(r"(.*?,.*?),?\s+and\s+((?:when|whenever|if)\b[^,]*,.*)", line, re.I)):
        first, others = joined[1], [joined[2]] if _is_rule(first) else []
        first = first if others else line
    yield first
    for other in others:
        yield f"{bullet[0]}{other}" if bullet and WHEN.match(first, bullet.end()) else other


def rule_sentence(condition: str, action: str) -> str:
    """Write a rule as a bullet, given the condition and the action from a table or from labels."""
    condition = re.sub(r"^\s*\(?(?:[a-z]|[ivx]{2,4}|\d+(?:\.\d+)+)[.)]\s+", "", condition, flags=re.IGNORECASE)
    condition = re.sub(r"^\W*(?:when|if|whenever)\s+", "", _bare(condition), flags=re.IGNORECASE)
    lead = re.match(r"(?:otherwise|else),?\s+if\s+", condition, re.IGNORECASE)
    when, condition = ("Otherwise, if", condition[lead.end() :]) if lead else ("When", condition)
    action = re.sub(r"^(?:the )?robot should\s+", "", _bare(action), flags=re.IGNORECASE)
    if (words := condition.lower().strip(",.:; ")) in PROGRAM_WORDS["always"]:
        return f"- {'Otherwise' if words in ('otherwise', 'else') else 'In all other cases'}, {action.rstrip('.; ')}."
    return f"- {when} {condition.rstrip(',.; ')}, the robot should {action.rstrip('.; ')}."


def _bare(text: str) -> str:
    """Remove double quotes, and the marks of emphasis and code in Markdown and HTML."""
    return re.sub(
        r"\*\*|__?(?<!\w_)(?=\w)|(?<=\w)__?(?!\w)|[`\"]|</?(?:b|strong|code|em|i|li|ul|ol|p)>", "", text
    ).strip()


def _is_rule(line: str) -> bool:
    start = BULLET.match(line)
    return WHEN.match(line, start.end() if start else 0) is not None


def _tables(lines: list[str]) -> None:
    columns: tuple[int, int] | None = None
    is_table, heads, nouns = False, list[str](), list[int]()
    for number, line in enumerate(lines):
        row = line.strip()
        if is_table and row[:2] in ("+-", "+="):
            lines[number] = ""
            continue
        if not (row.startswith("|") and row.count("|") >= 3) and not (is_table and " | " in row):
            is_table = False
            following = lines[number + 1] if number + 1 < len(lines) else ""
            if not (" | " in row and re.fullmatch(r"[\s:|-]*-[\s:|-]*\|[\s:|-]*-[\s:|-]*", following)):
                continue
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", row.strip("|"))]
        if not is_table:
            heads = [_bare(cell) for cell in cells]
            conditions = [at for at, head in enumerate(heads) if re.match(rf"{_CONDITION}\b", head, re.IGNORECASE)]
            actions = [at for at, head in enumerate(heads) if re.match(rf"{_ACTION}\b(?! not)", head, re.IGNORECASE)]
            nouns = [at for at, head in enumerate(heads) if is_noun(head) and at not in (*conditions, *actions)]
            columns = (conditions[0], actions[0]) if conditions and actions else (0, 1) if len(cells) == 2 else None
            is_table = True
            if columns is not None and (conditions or actions):
                lines[number] = ""
                continue
        if columns is None:
            continue
        is_row = len(cells) > max(columns) and re.search(r"\w", row)
        facts = [f"the {heads[at]} is {cells[at]}" for at in nouns if re.search(r"\w", cells[at])]
        condition = " and ".join([cells[columns[0]], *facts])
        lines[number] = rule_sentence(condition, cells[columns[1]]) if is_row else ""
