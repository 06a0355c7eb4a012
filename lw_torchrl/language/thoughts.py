"""What a model thought before it answered, and how models mark it; drafts in it are no answer."""

from __future__ import annotations

import re

from lw_torchrl.language.formats.written import Note

_OPENS = r"<think(?:ing)?>|\[think\]|<\|channel\|>(?:analysis|commentary)"
_CLOSES = r"</think(?:ing)?>|\[/think\]|<\|channel\|>final[^\n]{0,80}?<\|message\|>"
_TAG = re.compile(f"(?P<opens>{_OPENS})|{_CLOSES}", re.IGNORECASE)
_LINE_ENDS = re.compile(r"[ \t\r]*(?:\n|\Z)")
_COMMENT = re.compile(r"#(?!\w)")  # "#2" is none
_IS_JSON = re.compile(r"\s*(?:```\w*\s*)?\{")


def without_thoughts(text: str, notes: list[Note]) -> str:
    """The text without thoughts, which get a note; every line keeps its number.

    A closing tag alone closes what began before the text did, if it ends its line and stands in no comment of a plan;
    an opening tag in a comment or a string opens nothing. The tags of gpt-oss, which are no text, always count.

    Args:
        text: an answer; one that begins as JSON has no thoughts.
        notes: where the note goes.

    Example:
        >>> without_thoughts("<think>A draft.\\n</think>Done.", [])
        '\\nDone.'
        >>> without_thoughts("A draft. [/THINK]\\nDone. # </think>", [])
        '\\nDone. # </think>'
    """
    spans, opened, at, comment, quotes = list[tuple[int, int]](), None, 0, False, 0
    for tag in _TAG.finditer("" if _IS_JSON.match(text) else text):
        *lines, before = text[at : tag.start()].split("\n")
        if lines:
            comment, quotes = False, 0
        comment, quotes = comment or _COMMENT.search(before) is not None, quotes + before.count('"')
        at, special = tag.end(), tag[0].startswith("<|")
        if tag["opens"]:
            if opened is None and (special or not (comment or quotes % 2)):
                opened = tag.start()
        elif opened is not None:
            spans.append((opened, at))
            opened = None
        elif special or (not comment and _LINE_ENDS.match(text, at)):
            spans = [(0, at)]
    if opened is not None:
        spans.append((opened, len(text)))
    if not spans:
        return text
    how = "" if opened is None else ", and is cut off there"
    notes.append(Note(text.count("\n", 0, spans[0][0]) + 1, f"thinks aloud; that is left out{how}"))
    kept, at = list[str](), 0
    for start, end in spans:
        kept += [text[at:start], "\n" * text.count("\n", start, end)]
        at = end
    return "".join([*kept, text[at:]])
