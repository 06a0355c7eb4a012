"""A reader of programs in prose: numbered steps with "if", "otherwise", "once", "repeat until" and "go to step 4"."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import TRUE, Expression, all_of, as_expression, negate
from lw_torchrl.language.formats.base import END, PROGRAM_WORDS, Reading, in_turn, is_verb, statement
from lw_torchrl.language.formats.prose import NO_SKILL
from lw_torchrl.language.programs import Action, Block, Branch, Jump, Label, Loop, Node, Sequence, actions_of

_ITEM = re.compile(
    r"(\s*)(?:(?:(?:step|case|rule)\s+)?[\[(]?(\d{1,3})[.):\]]+|[-*•–+]|\(?(?:[a-z]|[ivx]{2,4})[.)])\s+(.*)",
    re.IGNORECASE,
)
_LONGEST = 1_000  # characters of a sentence
_NO_PROSE = re.compile(r"""\s*(?:[#`~{}<]|['"]{3}|(?:def|class|import|from|return) (?!to\b)|[\w.]+(?:\(| = ))""")
_HEADING = re.compile(r"\s*\*\*[^*]*\*\*:?\s*")
_LABEL = re.compile(r"[\w ]{1,30}\s[–—-]\s(?=(?:otherwise|if|when|while|once|unless|as long)\b)", re.IGNORECASE)
_LEAD = re.compile(
    r"(?:then|next|first|second|third|fourth|finally|lastly|last|now|and|also|after that|from there|in that case|please"
    r"|just|so)\b,?\s+",
    re.I,
)
_CATCH_ALL = (
    r"in (?:all|any|every) other (?:cases?|situations?)|anything else|(?:none|neither) of (?:the )?(?:above|these)"
    r"|(?:if|when) (?:none|neither)(?: of (?:these|them))? (?:applies|apply)(?=,)"
)
_OTHERWISE = re.compile(
    r"(?:otherwise|or else|else|failing that|(?:if|when) (?:not|it is not|it isn't|neither holds|we don't)(?=,)"
    rf"|if not|{_CATCH_ALL})(?:\b|(?<=\?))(?:[,:.?]| →)*\s*",
    re.IGNORECASE,
)
_WHEN = re.compile(
    r"(if|when|whenever|once|while|as long as|as soon as|after|unless|until|should|with)\s+(.+)", re.IGNORECASE
)
_TRAILING = re.compile(
    r"([^:]+?),?\s(if|when|unless|as long as|whenever|in case|provided(?: that)?)\s(.+)", re.IGNORECASE
)
_ANSWER = re.compile(
    r"if (?:(so|yes|it is|it does)|(?:no|not|it isn't|it is not))(?=[,:]|\s(?:and|but)\b)"
    r"(?:[,:]|\s(?:and|but) (it is)?(?:if )?)\s*",
    re.IGNORECASE,
)
_ASKS = re.compile(r"(?:check|see|test|start by asking|ask|look) (?:whether|if) (.+)", re.IGNORECASE)
_TELLS = re.compile(r"(?:the |its? )?[\w' ]+? (?:is|are|isn't|holds?) (.+)", re.IGNORECASE)
_RELATION = re.compile(
    r"\b(?:near|above|below|behind|aligned|around|open|closed|touching|(?:left|right|front) of)\b", re.I
)
_REPEAT = re.compile(
    r"(?:repeat|loop|keep (?:going|repeating|doing)|continue)\b"
    r"(?:.*?\bsteps?\s+(\d+))?.*?\b(until|while|as long as)\s+([^:]+)(:?.*)",
    re.IGNORECASE,
)
_GO_TO = re.compile(r"(?:go|skip|return|jump|move|continue|proceed|begin|start)\b.*?\bstep\s+(\d+)", re.IGNORECASE)
_SHOULD = re.compile(
    r"(?:then\s+)?(?:the\s+)?(?:robot|it|you|we)\s+(?:should|must|needs? to|has to|have to|will|can|shall)\s+"
    r"(?:then\s+|just\s+)?|(?:then|first|just|please|simply)\s+",
    re.IGNORECASE,
)
_DOES = re.compile(r"(?:it|(?:the )?robot|we|you|i) (\w+?)(s|es)?\b(?! \w+ing\b)", re.IGNORECASE)
_SUBJECT = re.compile(r"(?:not\s+)?((?:the|a)\s[\w' -]+?)\s(?:is|are|has|isn't)\b", re.IGNORECASE)
_OBJECT = re.compile(
    r"\b(?:near|above|with|of|around|behind|below|to|at|on|onto) ((?:the )[\w' -]+?)"
    r"(?= (?:and|or|but|is|are|isn't|nor|yet|if|when)\b|[,.;:)]|$)",
    re.IGNORECASE,
)
_TOPIC = re.compile(r"(?:look at|where is|what about|consider) (the [\w' ]+)", re.IGNORECASE)
_ACTED = re.compile(
    r"\w+ ((?:the|a) [\w' ]+?)(?: (?:above|to|over|into|onto|around|down|up|from|in|of|off|at|until|if|when)\b|$)",
    re.IGNORECASE,
)
_FILLER = re.compile(r"\s(?:already|still|yet|anymore|any more|now|either|also)\b(?! the)", re.IGNORECASE)
_CASES = re.compile(
    r"(?:either )?([^,]+), in which case (.+?)(?:,? or (?=.+, in which case)([^,]+), in which case (.+))?",
    re.IGNORECASE,
)
_ENDS = re.compile(rf"(?:.*\b(?:and|then)\s)?(?:{'|'.join(PROGRAM_WORDS['prose']['ends'])})\b", re.IGNORECASE)
_SENTENCES = re.compile(
    r"(?<=[.;!?])\s+|\s{2,}(?=\d{1,2}[.)]\s)|,\s+(?=(?:otherwise|or else|else)\b)"
    r"|(?:,\s+and|\s+and,)\s+(?=(?:if|when|once)\s(?:it|the)\b)"
)


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
        self.step, self.subject, self.object, self.line = 0, "", "", 1
        # The indent of the line, the question, and the answers above it.
        self.questions = list[tuple[int, Expression, Expression]]()
        self.guard = TRUE  # the answers that the current sentence depends on
        indents = [0]
        for number, line in enumerate(re.sub(r"[ \t]*→[ \t]*", ": ", text).splitlines(), 1):
            self.line = number
            before, *cut = END.split("" if _NO_PROSE.match(line) or _HEADING.fullmatch(line) else line, maxsplit=1)
            item, self.indent = _ITEM.match(before), len(before) - len(before.lstrip())
            while len(indents) > 1 and self.indent <= indents[-1]:
                indents.pop()
            while self.questions and (not item or self.indent <= self.questions[-1][0]) and before.strip():
                self.questions.pop()
            del self.scopes[len(indents) :]
            content = (item[3] if item else before).strip().replace("*", "").strip("\"'`")
            if item and item[2] and not indents[1:]:
                self.step = int(item[2])
                if not _OTHERWISE.match(content):
                    self.root.append(Label(item[2]))
            self.sentences(content, item is not None, len(indents))
            if content.endswith(":") and len(self.scopes) > len(indents):
                indents.append(self.indent)
            if cut:
                break
        tree = (Sequence if self.step else Block)(tuple(_built(self.root)))
        if next(actions_of(tree), None) is not None:
            self.add_tree("", 1, tree)

    def sentences(self, content: str, is_item: bool, base: int) -> None:
        """Add the sentences of a line; ``base`` is the number of scopes that stay open between sentences."""
        parts = _SENTENCES.split(content)
        while parts:
            part, after = parts.pop(0), parts[0] if parts else ""
            text = part.strip(" .;!,")
            other = _OTHERWISE.match(text)
            if topic := _TOPIC.match(text):
                self.subject = topic[1]
            elif asked := _ASKS.match(text):
                self.questions.append((self.indent, self.condition(asked[1]), TRUE))
            elif text.endswith("?") and _ANSWER.match(after):
                self.questions.append((self.indent, self.condition(text), TRUE))
            elif after and text.endswith("?") and not (other and other.end() == len(text)):
                asked_after = (other[0], text[other.end() :]) if other else ("", text)
                parts[0] = f"{asked_after[0]}if {statement(asked_after[1])}, {after}"
            elif after and other and other.end() == len(text):  # "None of these?"
                parts[0] = f"in all other cases, {after}"
            elif after and self.is_case(text, is_item, after):
                body = list[_Part]()
                self.scopes[-1].append(_Choice([(self.condition(text.rpartition(": ")[2]), body)]))
                self.scopes.append(body)
                base += 1
            else:
                self.sentence(text)
                if text.lower().endswith(tuple(PROGRAM_WORDS["prose"]["details"])):
                    base = len(self.scopes)
                elif part.endswith(".") and not _OTHERWISE.match(after):
                    del self.scopes[base:]

    def is_case(self, text: str, is_item: bool, after: str) -> bool:
        """Return whether a sentence describes the case in which the sentences after it apply."""
        if _WHEN.match(text) or _OTHERWISE.match(text) or not (is_item or after.lower().startswith("in that case")):
            return False
        told = text.rpartition(": ")[2]
        return (
            not _WHEN.match(told) and not _is_imperative(told) and bool(_TELLS.match(told) and _RELATION.search(told))
        )

    def sentence(self, text: str) -> None:
        """Add a sentence to the current scope."""
        if not text or len(text) > _LONGEST:
            return
        text = re.sub(r",?\s(?:on the other hand|however|instead),", "", text)
        text = _LABEL.sub("", text, count=1) if _LABEL.match(text) else text
        if self.questions and (answer := _ANSWER.match(text)):
            _, question, guard = self.questions[-1]
            self.guarded(
                all_of([guard, question if answer[1] else negate(question)]), text[answer.end() :], bool(answer[2])
            )
            return
        if (
            self.questions
            and self.guard == TRUE
            and self.questions[-1][2] != TRUE
            and self.questions[-1][0] < self.indent
        ):
            self.guarded(self.questions[-1][2], text)
            return
        if re.match(r"and (?:it|the [\w' ]+?) (?:is|isn't)\b", text):
            text = f"if {text[4:]}"
        while lead := _LEAD.match(text):
            text = text[lead.end() :]
        scope = self.scopes[-1]
        other = _OTHERWISE.match(text)
        chain = next((each for each in reversed(scope) if not isinstance(each, Label)), None)
        if other and isinstance(chain, _Choice) and chain.otherwise is None:
            text = text[other.end() :]
            if re.match(_CATCH_ALL, other[0], re.IGNORECASE):
                chain = _merged(scope)
        else:
            chain, text = None, text[other.end() :] if other else text
        while lead := _LEAD.match(text):
            text = text[lead.end() :]
        if cases := _CASES.fullmatch(text):
            self.sentence(f"if {cases[1]}, {cases[2]}")
            self.sentence(cases[3] and f"otherwise, if {cases[3]}, {cases[4]}")
            return
        repeat = _REPEAT.match(text)
        if repeat and chain is None:
            condition = self.condition(repeat[3])
            condition = negate(condition) if repeat[2].lower() == "until" else condition
            if not repeat[4]:
                self.root.append(_Repeat(repeat[1] or "", condition))
            elif repeat[4][1:]:
                self.sentence(repeat[4][1:].strip())
            return
        head, colon, rest = text.partition(": ")
        if colon and not _WHEN.match(text):
            is_case = _RELATION.search(head) and len(head.split()) > 2 and not is_verb(head.split())
            if is_case and (_is_imperative(rest) or _WHEN.match(rest)):
                self.conditional("if", head, rest, chain)
                return
            if _WHEN.match(rest):
                self.scopes.append(scope if chain is None else [])
                if chain is not None:
                    chain.otherwise = self.scopes[-1]
                self.sentence(rest)
                return
        if (when := _WHEN.match(text)) and (parts := self.split(when[2])) and (asked := _ASKS.match(parts[1])):
            guard = all_of([self.guard, self.condition(parts[0])])
            self.questions.append((self.indent, self.condition(asked[1]), guard))
        elif (when := _WHEN.match(text)) and (parts := self.split(when[2])):
            self.conditional(when[1].lower(), *parts, chain)
        elif (
            (when := _TRAILING.match(text))
            and is_verb(_imperative(when[1]).split())
            and not re.search(r"\buntil\b", when[1])
        ):
            self.trailing(when, chain)
        elif chain is not None:
            chain.otherwise = []
            if _is_imperative(text) or not _TELLS.match(text):
                self.body(text, chain.otherwise)
            else:  # "otherwise the gripper is on the wrong side; ..."
                self.scopes.append(chain.otherwise)
        elif _is_imperative(text):
            self.body(text, scope)
        elif _WHEN.match(text) and not text.endswith(":"):
            self.note(self.line, f"{shown(text)} is left out: it has no action")
        elif text.endswith(":") and _WHEN.match(text):
            self.conditional("if", text[:-1].split(" ", 1)[1], "", chain)
        elif any(_is_imperative(part) for part in re.split(r",\s+", text)[1:]):
            self.note(self.line, f"{shown(text)} is left out: its condition is not understood")

    def guarded(self, guard: Expression, text: str, continues: bool = False) -> None:
        """Add a sentence, or ask a question, under a condition."""
        if asked := _ASKS.match(text):
            self.questions.append((self.indent, self.condition(asked[1]), guard))
            return
        body = list[_Part]()
        self.scopes[-1].append(_Choice([(guard, body)]))
        self.scopes.append(body)
        before, self.guard = self.guard, guard
        text = text.partition(", so ")[2] or text  # "the way is free, so press the button"
        if continues:
            self.sentence(f"if it is {text}")
        elif _is_imperative(text) or _WHEN.match(text):
            self.sentence(text)
        elif "," in text or text.endswith(":"):
            self.sentence(f"if {text}")
        else:
            self.body(text, body)
        self.guard = before
        self.scopes.pop()

    def trailing(self, when: re.Match[str], chain: _Choice | None) -> None:
        """Add actions with their conditions behind them: "hold it if C, lift it if D, or lower it otherwise"."""
        action, word, rest = when.groups()
        first, *exception = re.split(r",\s+or\s+", action, maxsplit=1)
        if exception and is_verb(exception[0].split()):  # "move it, or lift it if C"
            self.subject = match[1] if (match := _ACTED.match(exception[0])) else self.subject
            self.conditional(word.lower(), rest, exception[0], chain)
            self.sentence(f"otherwise, {first}")
            return
        condition, *others = re.split(
            r",\s+(?:(?:and|or|else)\s+)*(?=(?!not\b)\w+\b.*(?:\sif\s|\swhen\s|\sotherwise$|\sif it is$))",
            rest,
            maxsplit=1,
        )
        if others and not is_verb(others[0].split()):
            head = " ".join(action.split(" ")[:2])
            others = [f"{head} {others[0]}"] if others[0].endswith(" otherwise") else []
            condition = condition if others else rest
        self.subject = match[1] if (match := _ACTED.match(action)) else self.subject
        self.conditional(word.lower(), condition, action, chain)
        if others:
            is_last = not re.search(r"\s(?:if|when)\s", others[0])
            self.sentence(
                "otherwise, " + (re.sub(r"\s(?:otherwise|if it is)$", "", others[0]) if is_last else others[0])
            )

    def condition(self, text: str) -> Expression:
        """Convert a condition in English; "it" is the last subject or object."""
        if (inside := re.search(r"\(([^()]* (?:is|are) [^()]*)\)", text)) and not re.search(
            r"\b(?:not|or|and|is)\s*$", text[: inside.start()]
        ):
            text = inside[1]  # "the puck is in the gripper (the gripper is near the puck and closed)"
        text = statement(" ".join(text.split()).rstrip(",:"))
        text = re.sub(r",?\s(?:but|though|although)\s", ", and ", _FILLER.sub("", f" {text}")).strip()
        text = re.sub(r",\s(?=(?:the|it)\b[^,]* (?:is|isn't)\b)", " and ", text)
        text = re.sub(r"^([^()]*\bor\b[^()]*),\sand\s(.*)$", r"(\1) and \2", text)  # "A or B, and C"
        text = re.sub(r",\s(?=(?:or|and)\b)", " ", text)
        if match := _SUBJECT.match(text):
            self.subject = match[1][0].lower() + match[1][1:]
        self.subject = self.subject or "the gripper"
        text = re.sub(r"(?<![\w'] )\b(it|its gripper)(?= (?:is|isn't|has)\b)", self.subject, text, flags=re.IGNORECASE)
        text = re.sub(r"\b(and|or|that|neither|if) it(?= (?:is|isn't)\b)", rf"\1 {self.subject}", text)
        names = [self.object]
        for match in _OBJECT.finditer(text):
            names.append(match[1])
        self.object = names[-1]
        if self.object:
            text = re.sub(
                r"\b(near|above|with|of|around|behind|below) it\b",
                rf"\1 {names[1] if names[1:] else self.object}",
                text,
            )
        return as_expression(text)

    def conditional(self, word: str, condition: str, action: str, chain: _Choice | None) -> None:
        """Add a sentence with a condition."""
        condition = re.sub(r"^(.+?) be ", r"\1 is ", condition) if word == "should" else condition
        test, body = self.condition(condition), list[_Part]()
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
        if _WHEN.match(text) or ((when := _TRAILING.match(text)) and "until" not in when[1]):
            self.scopes.append(body)
            self.sentence(text)
            return
        text = _imperative(text)
        text = text.removesuffix(" instead")
        if text.split(" ")[0].lower() in NO_SKILL:
            self.note(self.line, f"{shown(text)} is left out: it is not an action")
            return
        for action in actions_of(in_turn(text, self.line)):
            self.action(action, body)

    def split(self, text: str) -> tuple[str, str] | None:
        """Split "the gripper is open, close it" into the condition and the action."""
        places = [match for match in re.finditer(r",\s+|:\s+|\s+then\s+", text)]
        for match in places:
            after = text[match.end() :]
            if is_verb(_imperative(after).split()) or _WHEN.match(after) or _SHOULD.match(after):
                return text[: match.start()], after
        if places:
            return text[: places[-1].start()], text[places[-1].end() :]
        return (text[:-1], "") if text.endswith(":") else None

    def action(self, action: Action, body: list[_Part]) -> None:
        text = action.text.strip()
        if go_to := _GO_TO.match(text):
            body.append(Jump(go_to[1] if int(go_to[1]) > self.step else ""))
        elif text.lower() not in PROGRAM_WORDS["prose"]["continues"]:
            if text.lower() in ("close", "open"):
                text += f" {self.subject or 'the gripper'}"
            if " until " in text:
                acted = match[1] if (match := _ACTED.match(text)) else self.subject or "the gripper"
                text = re.sub(r"\buntil it (is|isn't)\b", rf"until {acted} \1", text)
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


def _merged(scope: list[_Part]) -> _Choice:
    """Join the choices at the end of a scope into one chain, for "in all other cases"."""
    chain = _Choice()
    while scope and isinstance(scope[-1], Label | _Choice):
        part = scope.pop()
        if isinstance(part, _Choice):
            if part.otherwise is not None:
                scope.append(part)
                break
            chain.branches = part.branches + chain.branches
    scope.append(chain)
    return chain


def _imperative(text: str) -> str:
    """Return "push it" for "the robot should push it" and "it pushes it"."""
    text = _SHOULD.sub("", text, count=1) if _SHOULD.match(text) else text
    if does := _DOES.match(text):
        verbs = (does[1], does[1] + (does[2] or "")[:-1])
        return next((verb + text[does.end() :] for verb in verbs if is_verb([verb])), text)
    return text


def _is_imperative(text: str) -> bool:
    words = _imperative(text).split()
    return (is_verb(words) and 1 < len(words) <= 40) or " ".join(words).lower() in PROGRAM_WORDS["prose"]["ends"]


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
