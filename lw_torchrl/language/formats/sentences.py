"""A reader of programs in prose: numbered steps with "if", "otherwise", "once", "repeat until" and "go to step 4"."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import Expression, as_expression, negate
from lw_torchrl.language.formats.base import END, PROGRAM_WORDS, Reading, in_turn, is_verb
from lw_torchrl.language.formats.prose import NO_SKILL
from lw_torchrl.language.programs import Action, Block, Branch, Jump, Label, Loop, Node, Sequence, actions_of

_ITEM = re.compile(r"(\s*)(?:(?:step\s+)?[\[(]?(\d{1,3})[.):\]]+|[-*•–+]|\(?[a-z][.)])\s+(.*)", re.IGNORECASE)
_LONGEST = 1_000  # characters of a sentence
_NO_PROSE = re.compile(r"""\s*(?:[#`~{}<]|['"]{3}|(?:def|class|import|from|return) (?!to\b)|[\w.]+(?:\(| = ))""")
_LEAD = re.compile(
    r"(?:then|next|first|finally|lastly|last|now|and|also|after that|in that case|please|just)\b,?\s+", re.I
)
_OTHERWISE = re.compile(r"(?:otherwise|or else|else|if not|in (?:all|any) other cases?)\b[,:]?\s*", re.IGNORECASE)
_WHEN = re.compile(r"(if|when|whenever|once|while|as long as|as soon as|after|unless|until)\s+(.+)", re.IGNORECASE)
_TRAILING = re.compile(r"(.+?),?\s(if|when|unless|as long as|whenever)\s(.+)", re.IGNORECASE)
_REPEAT = re.compile(
    r"(?:repeat|loop|keep (?:going|repeating)|continue)\b"
    r"(?:.*?\bsteps?\s+(\d+))?.*?\b(until|while|as long as)\s+(.+)",
    re.IGNORECASE,
)
_GO_TO = re.compile(r"(?:go|skip|return|jump|move|continue|proceed)\b.*?\bstep\s+(\d+)", re.IGNORECASE)
_SHOULD = re.compile(
    r"(?:then\s+)?(?:the\s+)?(?:robot|it|you|we)\s+(?:should|must|needs? to|has to|have to|will|can|shall)\s+"
    r"(?:then\s+|just\s+)?|(?:then|first|just|please|simply)\s+",
    re.IGNORECASE,
)
_SUBJECT = re.compile(r"(?:not\s+)?((?:the|a)\s[\w' -]+?)\s(?:is|are|has)\b", re.IGNORECASE)
_ENDS = re.compile(rf"(?:.*\b(?:and|then)\s)?(?:{'|'.join(PROGRAM_WORDS['prose']['ends'])})\b", re.IGNORECASE)


@dataclass
class _Choice:
    """A chain of "if ..., otherwise, if ..., otherwise ..." that may go on."""

    branches: list[tuple[Expression, list[_Part]]] = field(default_factory=list)
    otherwise: list[_Part] | None = None


@dataclass(frozen=True)
class _Repeat:
    """The instruction to repeat the steps from a number on ("" for all steps) while a condition is true."""

    first: str
    condition: Expression


_Part = Node | _Choice | _Repeat


class SentenceReading(Reading):
    """A reader of instructions, which become one tree. Numbered steps run in turn, other lines side by side."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.root: list[_Part] = []
        self.scopes = [self.root]  # the innermost list to which sentences are added
        self.step, self.subject, self.line = 0, "", 1
        indents = [0]
        for number, line in enumerate(text.splitlines(), 1):
            self.line = number
            before, *cut = END.split("" if _NO_PROSE.match(line) else line, maxsplit=1)
            item, indent = _ITEM.match(before), len(before) - len(before.lstrip())
            while len(indents) > 1 and indent <= indents[-1]:
                indents.pop()
            del self.scopes[len(indents) :]
            content = (item[3] if item else before).strip().replace("**", "").strip("\"'`")
            if item and item[2] and not indents[1:]:
                self.step = int(item[2])
                if not _OTHERWISE.match(content):
                    self.root.append(Label(item[2]))
            for sentence in re.split(r"(?<=[.;!?])\s+|\s{2,}(?=\d{1,2}[.)]\s)", content):
                self.sentence(sentence.strip(" .;!"))
            if content.endswith(":") and len(self.scopes) > len(indents):
                indents.append(indent)
            if cut:
                break
        tree = (Sequence if self.step else Block)(tuple(_built(self.root)))
        if next(actions_of(tree), None) is not None:
            self.add_tree("", 1, tree)

    def sentence(self, text: str) -> None:
        """Add a sentence to the current scope."""
        if not text or len(text) > _LONGEST:
            return
        while lead := _LEAD.match(text):
            text = text[lead.end() :]
        scope = self.scopes[-1]
        other = _OTHERWISE.match(text)
        chain = next((each for each in reversed(scope) if not isinstance(each, Label)), None)
        if other and isinstance(chain, _Choice) and chain.otherwise is None:
            text = text[other.end() :]
        else:
            chain, text = None, text[other.end() :] if other else text
        repeat = _REPEAT.match(text)
        if repeat and chain is None:
            condition = _condition(repeat[3])
            condition = negate(condition) if repeat[2].lower() == "until" else condition
            self.root.append(_Repeat(repeat[1] or "", condition))
        elif (when := _WHEN.match(text)) and (parts := _split(when[2])):
            self.conditional(when[1].lower(), *parts, chain)
        elif (when := _TRAILING.match(text)) and is_verb(when[1].split()) and not re.search(r"\buntil\b", when[1]):
            self.conditional(when[2].lower(), when[3], when[1], chain)
        elif chain is not None:
            chain.otherwise = []
            self.body(text, chain.otherwise)
        elif _is_imperative(text):
            self.body(text, scope)
        elif _WHEN.match(text) and not text.endswith(":"):
            self.note(self.line, f"{shown(text)} is left out: it has no action")
        elif text.endswith(":") and _WHEN.match(text):
            self.conditional("if", text[:-1].split(" ", 1)[1], "", chain)

    def conditional(self, word: str, condition: str, action: str, chain: _Choice | None) -> None:
        """Add a sentence with a condition."""
        self.subject = match[1] if (match := _SUBJECT.match(condition)) else self.subject
        test, body = _condition(condition), list[_Part]()
        test = negate(test) if word in ("unless", "until") else test
        scope = self.scopes[-1]
        if chain is not None:
            chain.branches.append((test, body))
        elif action.endswith(" instead") and (replaced := _last_action(scope)):
            replaced[-1] = _Choice([(test, body)], [replaced[-1]])
        else:
            scope.append(_Choice([(test, body)]))
        self.body(action, body)

    def body(self, text: str, body: list[_Part]) -> None:
        """Add the actions of a sentence to a list; a text that announces details opens a scope for them."""
        head, colon, rest = text.partition(":")
        if colon or not text or head.strip().lower() in PROGRAM_WORDS["prose"]["details"]:
            self.scopes.append(body)
            if rest:
                self.sentence(rest.strip())
            return
        if _WHEN.match(text):
            self.scopes.append(body)
            self.sentence(text)
            return
        text = _SHOULD.sub("", text, count=1) if _SHOULD.match(text) else text
        text = text.removesuffix(" instead")
        if text.split(" ")[0].lower() in NO_SKILL:
            self.note(self.line, f"{shown(text)} is left out: it is not an action")
            return
        for action in actions_of(in_turn(text, self.line)):
            self.action(action, body)

    def action(self, action: Action, body: list[_Part]) -> None:
        text = action.text.strip()
        if go_to := _GO_TO.match(text):
            body.append(Jump(go_to[1] if int(go_to[1]) > self.step else ""))
        elif text.lower() not in PROGRAM_WORDS["prose"]["continues"]:
            if self.subject and not any(isinstance(each, Action) for each in body):
                text = re.sub(r"^(\w+) it\b", rf"\1 {self.subject}", text)
            body.append(Action(text, action.line))
            if _ENDS.match(text):
                body.append(Jump())


def _last_action(parts: list[_Part]) -> list[_Part]:
    """Return the list whose last part is the last action; [] if the last part is not an action."""
    while parts and isinstance(last := parts[-1], _Choice):
        parts = last.branches[-1][1] if last.otherwise is None else last.otherwise
    return parts if parts and isinstance(parts[-1], Action) else []


def _split(text: str) -> tuple[str, str] | None:
    """Split "the gripper is open, close it" into the condition and the action."""
    places = [match for match in re.finditer(r",\s+|:\s+|\s+then\s+", text)]
    for match in places:
        words = _SHOULD.sub("", text[match.end() :], count=1).split()
        if is_verb(words) or _WHEN.match(text, match.end()) or _SHOULD.match(text, match.end()):
            return text[: match.start()], text[match.end() :]
    if places:
        return text[: places[-1].start()], text[places[-1].end() :]
    return (text[:-1], "") if text.endswith(":") else None


def _is_imperative(text: str) -> bool:
    words = (_SHOULD.sub("", text, count=1) if _SHOULD.match(text) else text).split()
    return (is_verb(words) and 1 < len(words) <= 40) or " ".join(words).lower() in PROGRAM_WORDS["prose"]["ends"]


def _condition(text: str) -> Expression:
    return as_expression(" ".join(text.split()).rstrip(",:"))


def _built(parts: list[_Part]) -> list[Node]:
    """Convert parts to programs. A repetition at the end is left out, since a plan repeats itself."""
    nodes = list[Node]()
    while parts and isinstance(parts[-1], _Repeat | Label):
        parts = parts[:-1]
    for part in parts:
        if isinstance(part, _Choice):
            last = None if part.otherwise is None else Sequence(tuple(_built(part.otherwise)))
            for condition, body in reversed(part.branches):
                last = Branch(condition, Sequence(tuple(_built(body))), last)  # type: ignore[assignment]
            nodes.append(last or Sequence())
        elif isinstance(part, _Repeat):
            start = nodes.index(Label(part.first)) if Label(part.first) in nodes else 0
            nodes[start:] = [Loop(part.condition, Sequence(tuple(nodes[start:])))]
        else:
            nodes.append(part)
    return nodes
