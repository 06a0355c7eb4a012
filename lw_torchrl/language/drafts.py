"""Remove the parts of an answer that are not its plan: drafts, quotations, examples, and text that is struck out."""

from __future__ import annotations

import re
from typing import NamedTuple

from lw_torchrl._util.checks import shown
from lw_torchrl.language.formats.base import Note

_BLOCK = r"[ \t]*```[^\n]*\n(?:(?![ \t]*```)[^\n]*\n)*[ \t]*```[ \t]*$"
_IF = r"\b(?:when|whenever|if|once|unless)\b"
_RULE = re.compile(rf"^[^\n]*{_IF}|^[ \t]*```\w+$", re.IGNORECASE | re.MULTILINE)
_RULES = rf"(?:(?![^\n]*:[ \t]*$|[ \t]*(?:- )?\w+: )[^\n]*{_IF}[^\n]*(?:\n|\Z))+"  # except keys in YAML
_DRAFT = re.compile(
    rf"(?:^[ \t]*>[^\n]*(?:\n|\Z))+"  # a quotation
    rf"|^[^\w\n\"']*(?:[❌✗✘]|(?:an? )?(?:wrong|incorrect|bad)(?: \w+)?:)[ \t]+(?=[^\n]*{_IF})[^\n]+"
    r"|^[^\w\n]*(?:(?:an?|the|as)\s+)?"  # rules or a block below a label such as "Wrong:"
    r"(?:wrong|incorrect|bad|do not|don't|never|avoid|not like|instead of|counter-?example)\b"
    rf"[^.\n]*:[^\w\n]*\n\s*(?:{_BLOCK}|{_RULES})"
    rf"|^[^\w\n]*(?:(?:for |an )?example|e\.g\.|(?:first|initial|old) \w+)\b[^.\n]*:[^\w\n]*\n\s*{_BLOCK}"
    rf"|^{_BLOCK}(?=\s*(?:that|this)(?: is| was|'s) (?:wrong|incorrect|not right)\b)",
    re.IGNORECASE | re.MULTILINE,
)
_DIFF = re.compile(r"^```diff\n.*?^```", re.MULTILINE | re.DOTALL)
_STRUCK = re.compile(r"~~(?=\S)[^~\n]+~~|<(del|s|strike)>.*?</\1>", re.IGNORECASE)
_ABOVE = (
    r"(?:that|this|it|(?:(?:all|everything|what I wrote|the (?:plan|rules?|text|version)) ?)?(?:of )?(?:the )?above"
    r"|(?:the|my) (?:previous|first|old|earlier|initial|original)\b(?: \w+)?)"
)
_WITHDRAWS = re.compile(  # withdraws the text above: "Wait, that is wrong."
    r"(?:(?:wait|hm+|actually|no|oops|sorry|hold on|on second thoughts?|correction|my mistake|but|edit|update|note)"
    r"\b[\s,.!:;–—-]*)*"
    rf"(?:{_ABOVE}(?: is| was|'s) (?!not )(?:\w+ )?"
    r"(?:wrong|incorrect|flawed|mistaken?|obsolete|outdated|superseded|invalid)"
    rf"|{_ABOVE} (?:(?:is|was|does) not|(?:is|was|does)n't) (?:\w+ )?(?:right|correct|work)"
    rf"|(?:please )?(?:scratch|strike|ignore|disregard|discard|forget)(?: all| about| of)* {_ABOVE}"
    r"|let me (?:start over|(?:start|try) (?:this |that |it )?again|(?:redo|rewrite|correct|fix|revise)"
    r"(?: (?:that|this|it|myself))?))(?=\s*(?:[.!,;–—-]|$)| (?:because|since|as|so)\b)",
    re.IGNORECASE,
)
_PLAN = r"(?:plan|version|answer|solution|policy|program|draft|attempt)"
_NEWER = (
    r"(?:final|correct(?:ed)?|revised|updated|fixed|improved|amended|rewritten|refined|definitive|actual|real|better"
    r"|new)"
)
_ANNOUNCES = re.compile(  # announces the plan that replaces the text above: "Here is the corrected plan:"
    rf"(?!.*(?:{_IF}|\b(?:summary|overview|check|phase|stage|steps?)\b))(?:(?:[\w', ]{{0,40}} )?"
    rf"(?:{_NEWER}(?:(?: \w+)? {_PLAN}| (?:rules|code|list|response))|second (?:attempt|version|draft|try))\b"
    r"[^.:]{0,40}|final|correct(?:ed|ion)|revised|updated|(?:please )?(?:use|follow)\b[^.:]{0,30}\binstead)",
    re.IGNORECASE,
)
_IS_DRAFT = re.compile(  # a heading
    r"\b(?:draft|(?:do not|don't|not to|never) use|discarded|deprecated|obsolete|outdated|rejected|abandoned|superseded"
    rf"|old|(?:first|initial|previous|earlier|original|rough|wrong|incorrect|bad) (?:{_PLAN}|rules)"
    r"|counter-?examples?)\b|^(?:an |for )?examples?(?: (?:rules?|output|plan))?$"
    r"|^(?:(?:the robot|you|it) )?(?:(?:must|should|may) not|do nots?|don'?ts?|never|avoid|(?:how|what) not to"
    r"|forbidden|prohibited)\b",
    re.IGNORECASE,
)
_ITEM = re.compile(r"\s*(?:[-•+]|\*(?!\*)|\d+[.)])\s")
_BEGINS = re.compile(  # a rule or code
    rf"[^\w\n]*(?:(?:\w+ )?\w+[.):]\s*)?{_IF}|{_ITEM.pattern}.*(?:{_IF}|→|->)|\s*(?:```|~~~|def |\[?{{|\|)",
    re.IGNORECASE,
)
_TITLE = re.compile(r"\s*(?:(?P<level>#{1,6})\s.*|(?P<bold>\*\*|__)[^*]+(?:\*\*|__):?|.*:[*_]*)\s*")
_CODE = re.compile(r"^[ \t]*(?:(?:def|class) \w|import \w|if .*\(.*:[ \t]*$)", re.MULTILINE)
_MARKUP = " \t#*_=:->"
# A rule in quotation marks in a sentence with other words: 'You wrote "When ..., ...".' But a label with a quotation is
# a rule: 'Rule 1: "When ..., ..."'.
_QUOTED = rf"[\"“«`]\W{{0,3}}{_IF}[^\"”»`\n]{{1,400}}(?:,| then )[^\"”»`\n]{{1,400}}[\"”»`]"
_SENTENCE, _OTHER = r"(?:^|(?<=[.!?] ))", r"\"“«`.!?\n(=\[{|"
_LABEL = r"[^\w\n\"“«`]*+(?:[\w-]{1,40} )?[\w-]{1,40}:[^\w\n\"“«`]*+"
_QUOTATION = re.compile(
    rf"{_SENTENCE}(?!{_LABEL}{_QUOTED})[^\w{_OTHER}]*+\w[^{_OTHER}]*+{_QUOTED}[^\w\n]?"
    rf"|{_SENTENCE}[^\w\n\"“«`]*+{_QUOTED} (?!(?:and|then|or)\b)[a-z][^.!?\n]*[.!?]?"
    rf"|^(?=[^:\n]{{0,60}}\b(?:said|wrote|asked|suggested|prompt|examples?|mistakes?|format|template):){_LABEL}{_QUOTED}"
    r"[^\w\n]?",
    re.IGNORECASE | re.MULTILINE,
)


class _Line(NamedTuple):
    """A line of prose."""

    start: int
    text: str
    level: int  # of a heading: 1 to 6 in Markdown, 7 in bold, 8 before a colon; 0 for other lines


def without_drafts(text: str, notes: list[Note]) -> str:
    """Remove text that an answer strikes out, quotes, withdraws, or labels as draft, wrong or example; append notes.

    Except for struck-out text, a part is removed only if a rule or another block of code remains.
    """
    spans = [match.span() for match in _STRUCK.finditer(text)]
    drafts = [match.span() for match in _DRAFT.finditer(text)]
    for fence in _DIFF.finditer(text):
        removed = re.compile(r"^-.*$", re.MULTILINE).finditer(text, *fence.span())
        drafts += [match.span() for match in removed]
    lines = _lines(text)
    quoted = [match.span() for match in _QUOTATION.finditer(text)]
    for parts in (drafts, _withdrawn(lines), _draft_sections(lines), quoted):
        rest = cut_out(text, merged := _merged([*spans, *parts]))
        if _RULE.search(rest) if parts is drafts else any(map(_BEGINS.match, rest.splitlines())):
            spans = merged
    for start, end in spans:
        reason = "struck out" if text[start] in "~<" else "a draft, a quotation or a prohibition"
        notes.append(Note(text.count("\n", 0, start) + 1, f"{reason}: {shown(text[start:end].strip())} is left out"))
    return cut_out(text, spans)


def _lines(text: str) -> list[_Line]:
    """Return the lines of a text; those inside fences and code are blank."""
    text = re.sub(rf"(?m)^{_BLOCK}", lambda block: _blank_inside(block[0]), text)
    is_code = _CODE.search(text) is not None
    lines, start = list[_Line](), 0
    for written in text.splitlines(keepends=True):
        line = "" if is_code and written[:1] in " \t#" else written.rstrip()
        title = None if _ITEM.match(line) or _BEGINS.match(line) or len(line) > 200 else _TITLE.fullmatch(line)
        level = 0 if title is None else len(title["level"]) if title["level"] else 7 if title["bold"] else 8
        lines.append(_Line(start, line, level))
        start += len(written)
    return lines


def _blank_inside(block: str) -> str:
    """Replace the characters after the first line of a block with blanks."""
    first, _, rest = block.partition("\n")
    return f"{first}\n" + re.sub(r"[^\n]", " ", rest)


def _replaces(line: _Line) -> bool:
    """Return whether a line withdraws the text above it, or announces the plan that replaces it."""
    if _ITEM.match(line.text) or _BEGINS.match(line.text):
        return False
    text = line.text.strip(_MARKUP)
    last = re.split(r"(?<=[.!?])\s+", text)[-1].rstrip(".")
    is_announcement = line.level > 0 or re.match(r"(?:here|below|this is)\b", last, re.IGNORECASE)
    return bool(_WITHDRAWS.match(text) or (is_announcement and _ANNOUNCES.fullmatch(last)))


def _withdrawn(lines: list[_Line]) -> list[tuple[int, int]]:
    """Return the span of withdrawn text: from the plan's first rule to the last line that withdraws or replaces it."""
    rules = [number for number, line in enumerate(lines) if _BEGINS.match(line.text)]
    first = next((number for number, line in enumerate(lines) if _BEGINS.match(line.text) or _ITEM.match(line.text)), 0)
    end = next((number for number in reversed(range(first, rules[-1] if rules else 0)) if _replaces(lines[number])), 0)
    return [(lines[first].start, lines[end].start)] if end else []


def _draft_sections(lines: list[_Line]) -> list[tuple[int, int]]:
    """Return the spans of sections with drafts, each up to the next heading of the same or a higher level."""
    spans = list[tuple[int, int]]()
    for number, line in enumerate(lines):
        if not (line.level and _IS_DRAFT.search(line.text.replace("*", "").strip(_MARKUP))) or _replaces(line):
            continue
        end = number + 1
        while end < len(lines) and not _ends(line, lines[end]):
            end += 1
            if line.level == 8 and lines[end - 1].text and not (end < len(lines) and lines[end].text):
                break  # a label applies to one paragraph
        spans.append((line.start, lines[end].start if end < len(lines) else lines[-1].start + len(lines[-1].text)))
    return spans


def _ends(heading: _Line, line: _Line) -> bool:
    """Return whether a line ends the section of a heading; below a label or bold text, any heading of a plan does."""
    is_plan = heading.level > 6 and line.level > 0 and re.search(rf"\b(?:{_PLAN}|rules)\b", line.text, re.IGNORECASE)
    return 0 < line.level <= heading.level or bool(is_plan) or _replaces(line)


def _merged(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Join spans that overlap."""
    merged = list[tuple[int, int]]()
    for start, end in sorted(spans):
        if merged and start < merged[-1][1]:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((start, end))
    return merged


def cut_out(text: str, spans: list[tuple[int, int]]) -> str:
    """Remove spans, but not their line breaks, so that line numbers stay the same."""
    kept, at = list[str](), 0
    for start, end in spans:
        kept += [text[at:start], "\n" * text.count("\n", start, end)]
        at = max(at, end)
    return "".join([*kept, text[at:]])
