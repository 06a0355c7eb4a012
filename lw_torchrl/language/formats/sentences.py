"""A reader of programs in prose: numbered steps with "if", "otherwise", "once", "repeat until" and "go to step 4"."""

from __future__ import annotations

import re
from functools import lru_cache

from lw_torchrl._util.checks import shown
from lw_torchrl.language.formats.base import END, PROGRAM_WORDS, Reading, Section, is_verb
from lw_torchrl.language.formats.clauses import PATTERNS, RELATION, clauses, is_action, is_state
from lw_torchrl.language.formats.line_parser import Choice, LineParser, Open, Part, Repeat
from lw_torchrl.language.formats.markup import WHEN
from lw_torchrl.language.formats.phrases import is_noun, role_of
from lw_torchrl.language.formats.references import References
from lw_torchrl.language.programs import Block, Branch, Label, Loop, Node, Sequence, actions_of
from lw_torchrl.language.tasks import TASKS

_LONGEST = 4_000  # maximum length of a line (characters)
_REWRITINGS = [(re.compile(text, re.IGNORECASE), plain) for text, plain in PROGRAM_WORDS["prose"]["rewritings"]]


class SentenceReading(Reading):
    """A reader that converts instructions to one tree. Numbered steps run in sequence, and rules run concurrently."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.root: list[Part] = []
        self.scopes = [self.root]  # the open lists; clauses are added to the last one
        self.refers = References()
        self.opens = list[Open]()
        self.step, self.line = 0, 1
        self.has_jumps = False  # whether a step jumps to a later step
        self.is_case = False  # whether the line above only describes a case: "Case 1: the gripper is open."
        self.is_below = False  # whether the line above is an action for such a case
        self.levels = list[tuple[float, int]]()  # the indent of each line above, and the number of scopes at its start
        if PATTERNS["to_step"].search(text) is None:
            text = PATTERNS["numbered_rule"].sub(r"\1- ", text)  # "1. the gripper is open -> close it"
        lines = _unwrapped(text.splitlines())
        lines = [PATTERNS["arrow"].sub(lambda arrow: f"{arrow[1] or ':'} ", _arrow_rule(line)) for line in lines]
        for line in lines:
            self.content(line[:_LONGEST].strip(" -*•"))  # definitions may follow their use
        for self.line, line in enumerate(lines, 1):
            if len(line) > _LONGEST:
                self.note(self.line, f"the rest of {len(line)} characters is not read")
                line = line[:_LONGEST]
            heading = PATTERNS["heading"].fullmatch(line) is not None
            is_code = (PATTERNS["no_prose"].match(line) and not heading) or PATTERNS["code"].match(line)
            before, *cut = END.split("" if is_code else line, maxsplit=1)
            is_title = before.strip(" #*").partition(":")[0] in TASKS  # "# push: Slide it to the goal."
            is_forbidden = PATTERNS["prohibits"].match(before) is not None
            if is_title or is_forbidden or PATTERNS["describes"].match(before):
                reason = "it is forbidden" if is_forbidden else "it describes the task"
                self.note(self.line, f"{shown(before.strip())} is left out: {reason}")
                before = ""
            self.is_case &= bool(line.strip()) or not self.is_below
            if before.strip():
                self.read(before, next((each for each in lines[self.line :] if each.strip()), ""), heading)
            if cut:
                break
        steps: list[Part] = [part for part in self.root if not isinstance(part, Label)]
        is_in_turn = self.step and (self.has_jumps or not all(isinstance(part, Choice) for part in steps))
        tree = Sequence(tuple(_built(self.root))) if is_in_turn else Block(tuple(_built(steps)))
        if next(actions_of(tree), None) is not None:
            self.sections.append(Section("", 1, tree=tree))

    def read(self, line: str, following: str, is_heading: bool) -> None:
        """Add the clauses of a line, nested according to the line's indentation."""
        item, indent = PATTERNS["item"].match(line), float(_indent(line))
        self.is_below = self.is_case and not item
        if self.levels and (PATTERNS["reply"].match(line) or self.is_below):
            indent = self.levels[-1][0] + 0.5  # below the condition in the line above
        while self.levels and indent <= self.levels[-1][0]:
            del self.scopes[self.levels.pop()[1] :]
        self.levels.append((indent, len(self.scopes)))
        has_item = PATTERNS["item"].match(following) is not None
        content = self.content(item[3] if item else line)
        is_open = content.endswith(":") and not is_heading and _indent(following) <= indent
        is_split = is_open or following.lower().startswith("then ")
        goes_on = self.is_below and PATTERNS["line_start"].match(following.lstrip()) is None
        case = "if" if is_split else "act" if goes_on else "state" if item and following else ""
        self.is_case = bool(case) and not has_item and {clause.kind for clause in clauses(content)} == {case}
        is_head = is_heading or (self.is_case and case != "act")
        is_head |= _indent(following) > indent and (has_item or item is not None)
        if item and item[2] and PATTERNS["alternative"].match(line) is None and self.scopes[-1] is self.root:
            self.step = int(item[2])
            self.root.append(Label(item[2]))
        is_item = item is not None or PATTERNS["bold"].match(line) is not None
        is_title = PATTERNS["heading"].fullmatch(item[3] if item else line) and WHEN.match(following.lstrip(" -*"))
        if not is_title or not is_action(content.rpartition(": ")[2]):
            LineParser(self, content.rstrip("." * self.is_case), is_item, is_head, is_heading).read()
            last = clauses(content)[-1:] if has_item and item is None and content.endswith(".") else []
            if any(each.kind in ("act", "say") and not PATTERNS["announces"].search(each.text) for each in last):
                del self.scopes[self.levels[-1][1] :]  # the list below a complete rule contains separate rules

    def content(self, text: str) -> str:
        """Return the content of a line without markup and in usual words; remember a name that the line defines."""
        text = PATTERNS["summary"].sub("", text.strip(" \t#"))
        if (defined := PATTERNS["defined"].fullmatch(text)) and is_state(defined[3]):
            text = f'"{defined[2]}": {defined[3]}'
        text = usual_words(text.replace("*", "").strip("`"))
        return PATTERNS["named"].sub(self.define, text).strip("\"'")

    def define(self, named: re.Match[str]) -> str:
        """Remember the name of a condition, and return ""; if the text defines no condition, return the text."""
        name, meaning = named[1] or named[2], named[3]
        if (
            not RELATION.search(meaning)
            or role_of(name) == "comment"
            or (RELATION.fullmatch(name) and not name.isupper())
        ):
            return named[0]
        self.refers.names[name] = meaning.rstrip(".")
        return ""


def _arrow_rule(line: str) -> str:
    """Rewrite "the gripper is tired → open it" as a sentence with "if"; other lines stay as they are."""
    arrow, item = PATTERNS["arrow"].search(line), PATTERNS["item"].match(line)
    if arrow is None or arrow[1] or PATTERNS["arrow"].search(line, arrow.end()):
        return line
    start = item.start(3) if item else len(line) - len(line.lstrip())
    state, action = line[start : arrow.start()].strip(), line[arrow.end() :]
    words = state.split()
    is_label = ":" in state or (len(words) < 3 and not is_noun(" ".join(words[:1])))
    if is_label or is_verb(words) or PATTERNS["line_start"].match(state) or not is_verb(action.split()):
        return line
    return f"{line[:start]}if {state}: {action}"


@lru_cache(maxsize=4096)
def usual_words(text: str) -> str:
    """Rewrite phrases that the parser of clauses does not know."""
    for pattern, plain in _REWRITINGS:
        text = pattern.sub(plain, text)
    return text


def _unwrapped(lines: list[str]) -> list[str]:
    """Join each wrapped line with the line in which its sentence begins; the number of lines stays the same."""
    joined, first = list(lines), 0
    for number, line in enumerate(lines):
        words = line.split()
        goes_on = number and PATTERNS["wrapped"].search(lines[number - 1]) and not PATTERNS["item"].match(line)
        begins = not words or not words[0][0].islower() or is_verb(words) or PATTERNS["line_start"].match(words[0])
        begins = begins or PATTERNS["arrow"].search(line)
        is_open = number and len(lines[number - 1]) > 30 and PATTERNS["line_end"].search(lines[number - 1]) is None
        if words and (goes_on or (is_open and not begins)) and len(joined[first]) < _LONGEST:
            joined[first] += f" {line.strip()}"
            joined[number] = ""
        else:
            first = number
    return joined


def _indent(line: str) -> int:
    """Return the depth of a line: up to 7 for a heading, otherwise at least 10, growing with indentation and items."""
    blanks, content = len(line) - len(line.lstrip()), line.lstrip()
    if (
        PATTERNS["heading"].fullmatch(line)
        and not PATTERNS["item"].match(line)
        and not content.rstrip("* ").endswith(":")
    ):
        return len(content) - len(content.lstrip("#")) or 7
    is_item = PATTERNS["item"].match(line) is not None and not content[:1].isalpha()  # "Step 1:" may be above a list
    return 10 + 2 * blanks + is_item + len(re.findall(r"^[\d.]+", content)[:1])


def _built(parts: list[Part]) -> list[Node]:
    """Convert parts to programs. A repetition at the end is left out, since a plan repeats itself."""
    nodes = list[Node]()
    while parts and isinstance(parts[-1], Repeat | Label):
        parts = parts[:-1]
    for part in parts:
        if isinstance(part, Choice):
            last = None if part.otherwise is None else Sequence(tuple(_built(part.otherwise)))
            for condition, body in reversed(part.branches):
                last = Branch(condition, Sequence(tuple(_built(body))), last)  # type: ignore[assignment]
            nodes.append(last or Sequence())
        elif isinstance(part, Repeat):
            start = nodes.index(Label(part.first)) if Label(part.first) in nodes else 0
            nodes[start:] = [Loop(part.condition, Sequence(tuple(nodes[start:])))]
        else:
            nodes.append(part)
    return nodes
