"""Remove a language model's reasoning, which may contain drafts of a plan, from its answer."""

from __future__ import annotations

import re
from collections.abc import Iterator

from lw_torchrl.language.drafts import cut_out
from lw_torchrl.language.formats.base import Note

_THOUGHT = (
    r"(?:think(?:ing)?|thoughts?|reason(?:ing)?|reflections?|scratch[ _-]?(?:pad|work)|analysis|monologue|deliberation|"
    r"brainstorm(?:ing)?|rumination|chain[ _-]of[ _-]thought|cot)"
)
_OPENS = (
    r"<think(?:ing)?>|\[think\]|<\|channel\|?>(?:analysis|commentary|thought)"
    rf"|<\|(?:begin|start)_(?:of_)?{_THOUGHT}\|>"
)
_CLOSES = (
    r"</think(?:ing)?>|\[/think\]|<channel\|>|<\|channel\|>final[^\n]{0,80}?<\|message\|>"
    rf"|<\|end_(?:of_)?{_THOUGHT}\|>"
)
_TAG = re.compile(f"(?P<opens>{_OPENS})|{_CLOSES}", re.IGNORECASE)
_LINE_ENDS = re.compile(r"[ \t\r]*(?:\n|\Z)")
_COMMENT = re.compile(r"#(?!\w)")  # "#2" is not a comment
_IS_JSON = re.compile(r"\s*(?:```\w*\s*)?\{(?!\{)")
_LEFT, _RIGHT = r"(?:[<\[{(◁⟨«]{1,2}\|?)", r"(?:\|?[>\]})▷⟩»]{1,2})"
_ENDS = r"/|end[ _](?:of[ _])?"
# A marker such as <seed:think>, [/THOUGHT], <|begin_of_thought|>, <|END_THINKING|> or ◁think▷; comments; and fences.
_MARKER = re.compile(
    rf"^[ \t]*{_LEFT}(?:(?P<ends>{_ENDS})|(?:begin|start)[ _](?:of[ _])?)?"
    rf"(?P<name>[a-z][\w:.-]*)(?: [^<>\n]{{0,80}})?{_RIGHT}"
    rf"|{_LEFT}(?P<last>{_ENDS})(?P<named>[a-z][\w:.-]*){_RIGHT}"
    r"|^[ \t]*(?P<comment><!--)|(?P<commented>-->)"
    rf"|^[ \t]*```[ \t]*(?P<fence>{_THOUGHT})[ \t]*$|^[ \t]*(?P<fenced>```)[ \t]*$",
    re.IGNORECASE | re.MULTILINE,
)
_IS_THOUGHT = re.compile(rf"(?:\w+[:_.-])?\w*?{_THOUGHT}(?:[_-]\w+)?|!--|```", re.IGNORECASE)
_IS_ANSWER = re.compile(
    r"(?:final[_-]?)?(?:answer|plan|policy|output|response|result|solution|code|rules?|task|steps?|program|ul|ol|li|p|pre"
    r"|div|table|b|strong|python|json|body|html|robot)\w*|s|del|strike",
    re.IGNORECASE,
)
_HEADING = re.compile(
    rf"\s*(?:#{{1,6}}\s*|\*\*|__|\[\[ ## |[-=~]{{2,}}\s*)?(?:let me |here(?:'s| is) )?(?:my |the |initial )?{_THOUGHT}"
    r"(?: (?:process|steps?|aloud))?\s*"
    r"(?:\.{3}|…|\([^()\n]{1,60}\))?:?(?:\*\*|__| ## \]\]|\s*[-=~]{2,})?:?[ \t]*(?:\n|\Z)",
    re.IGNORECASE,
)
_NEXT_HEADING = re.compile(
    r"^[ \t]*(?:#{1,6}\s+\S.*|\[\[ ## .* ## \]\]|\w[^\n]{1,60}\n[ \t]*[=-]{3,}[ \t]*"
    r"|(?:\*\*|__)[^*_\n]+(?:\*\*|__)[ \t]*:?[ \t]*|-{3,}[ \t]*|(?:\.{3}|…)[ \t]*done.*"
    r"|(?:[\w']+ ){0,5}(?:answer|plan|output|solution|rules|response|result|code)\b[^.:\n]{0,40}:[ \t]*)$",
    re.IGNORECASE | re.MULTILINE,
)


def without_thoughts(text: str, notes: list[Note]) -> str:
    """Remove the model's reasoning from an answer, and append a note to ``notes``. Line numbers do not change.

    Reasoning is the text between two markers with a name such as "think" or "reasoning", in any brackets. At the
    beginning of the answer, it is also the text between two markers with any name except "answer" and "plan", and the
    text under a heading such as "Thinking".

    A ``</think>`` without ``<think>`` ends reasoning that began before the text, unless the tag is in a comment or more
    text follows on the line. A ``<think>`` without ``</think>`` means that the rest of the text is reasoning. A
    ``<think>`` in a comment or a string is ignored. Tags of gpt-oss are never ignored. Answers in JSON are unchanged.
    """
    if _IS_JSON.match(text):
        return text
    spans, is_cut = _tagged(text)
    if not spans:
        spans = [*_marked(text), *_headed(text)]
        if not cut_out(text, spans).strip():
            return text
    if not spans:
        return text
    how = " (there is no end tag)" if is_cut else ""
    notes.append(Note(text.count("\n", 0, spans[0][0]) + 1, f"the model's reasoning is left out{how}"))
    return cut_out(text, spans)


def _tagged(text: str) -> tuple[list[tuple[int, int]], bool]:
    """Return the spans of reasoning in well-known tags, such as <think>, and whether the last span has no closing tag.

    A closing tag without an opening tag ends a span that begins at the start of the text.
    """
    # comment: whether the current position is in a comment; quotes: the number of quotes in the line so far.
    spans, opened, at, comment, quotes = list[tuple[int, int]](), None, 0, False, 0
    for tag in _TAG.finditer(text):
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
    return spans, opened is not None


def _marked(text: str) -> Iterator[tuple[int, int]]:
    """Yield the (start, end) spans of reasoning between balanced markers, including the markers."""
    end, opened = 0, dict[str, int]()
    for marker in _MARKER.finditer(text):
        if marker.start() < end:
            continue
        name = (marker["name"] or marker["named"] or "").lower()
        if not name:
            name = "!--" if marker["comment"] or marker["commented"] else "```"
        if marker["ends"] or marker["last"] or marker["commented"] or marker["fenced"]:
            if (start := opened.get(name)) is not None:
                yield start, marker.end()
                end = marker.end()
                opened.clear()
            elif end == 0 and re.search(_THOUGHT, name) and not _TAG.search(marker[0]):  # began before the text
                yield 0, marker.end()
                end = marker.end()
        elif _IS_THOUGHT.fullmatch(name) or (not text[: marker.start()].strip() and not _IS_ANSWER.fullmatch(name)):
            opened.setdefault(name, marker.start())


def _headed(text: str) -> Iterator[tuple[int, int]]:
    """Yield the span of the text under a heading such as "Thinking" at the beginning, if another heading follows."""
    heading = _HEADING.match(text)
    if heading and (following := _NEXT_HEADING.search(text, heading.end())):
        is_done = re.match(r"\W*done", following[0]) is not None
        yield heading.start(), following.end() if is_done else following.start()
