"""Resolve references such as "it", "there", a bare "open" and "once it is" in the conditions and actions of prose."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from lw_torchrl.language.expressions import TRUE, Expression, as_expression, negate
from lw_torchrl.language.formats.base import PROGRAM_WORDS, statement
from lw_torchrl.language.formats.clauses import PATTERNS, RELATION, STATES

_REWRITINGS = [(re.compile(text, re.IGNORECASE), plain) for text, plain in PROGRAM_WORDS["prose"]["conditions"]]


@dataclass
class References:
    """The objects, the place and the condition that later words refer to."""

    subject: str = ""  # of the last condition
    object: str = ""  # the other object of the last condition
    place: str = ""  # to which the last action leads
    held: str = ""
    aligned: str = ""  # "vertically aligned with the mug"
    last: Expression = TRUE  # the condition that "it is" repeats
    names: dict[str, str] = field(default_factory=dict)  # the conditions that the text defines, by name

    def condition(self, text: str) -> Expression:
        """Convert a condition in English to an expression, and resolve its references."""
        text = " ".join(text.split())
        for name, meaning in self.names.items():
            named = rf"\b(?:the )?{name}(?: (?:is|are) (?:met|true|satisfied)| holds| applies)?\b"
            flags = 0 if name.isupper() else re.IGNORECASE  # "OVER" is a name, "over" is not
            text = re.sub(named, f"({meaning})".replace("\\", ""), text, flags=flags)
        for pattern, plain in _REWRITINGS:
            text = pattern.sub(plain, text)
        text = re.sub(r"\bthere\b(?=$|,| (?:and|or|but)\b)", self.place.replace("\\", "") or "there", text)
        text = _explained(text)
        if further := re.match(r"(.*?),? that is,? (?:whether |if )?(.*)", text):  # "on the shelf, that is, near it"
            self._joined(further[1])
            text = further[2]
        text = self._holding(statement(" ".join(text.split()).strip(" ,:")))
        text = self._joined(text) or text
        self.last = _affirmed(text)
        return as_expression(text)

    def is_named(self, text: str) -> bool:
        """Return whether a text contains the name of a condition."""
        return any(re.search(rf"\b{name}\b", text, re.IGNORECASE) for name in self.names)

    def _holding(self, text: str) -> str:
        """Rewrite "the mug is held" and "it has the mug" as "the gripper is holding the mug"."""
        known = next((each for each in (self.held, self.subject, self.object) if each and "gripper" not in each), "it")

        def holding(match: re.Match[str]) -> str:
            self.held = known if match["held"].lower() == "it" else match["held"]
            goes_on = re.match(r" (?:and|or) (?:not )?(?!the\b|it\b)\w", text[match.end() :])
            words = f"the gripper is {'not ' if ' not ' in match[0] else ''}holding {self.held}"
            return f"{words} and {self.held} is" if goes_on and match.re is PATTERNS["held"] else words

        text = PATTERNS["held"].sub(holding, text := PATTERNS["holds"].sub(holding, text, count=1))
        return re.sub(r"(gripper is (?:not )?holding (the [\w' ]+?) (?:and|or)) it\b", r"\1 \2", text)

    def _joined(self, text: str) -> str:
        """Complete each part of a condition: "the gripper is open and above it" gives two sentences."""
        text = re.sub(r"^(?:and|or|but) ", "", text)
        text = PATTERNS["shared"].sub(lambda shared: re.sub(" (and|or) ", "\0\\1\0", shared[0]), text)
        pieces = [*PATTERNS["joints"].split(text), ""]
        result = ""
        for number in range(0, len(pieces) - 1, 2):
            gap = pieces[number + 1]
            joint = gap.strip(" ,").lower()
            if part := pieces[number].strip():
                following = next((each.strip() for each in pieces[number + 2 :: 2] if each.strip()), "")
                result += f" {self._part(part, following, joint)}"
            joint = "and" if joint in ("but", "yet", "though", "although") or gap.strip() == "," else joint
            if joint == "and" and gap.startswith(",") and re.search(r"\bor\b[^()]*$", result) and "(" not in result:
                result = f" ({result.strip()})"  # "A or B, and C"
            result += f" {joint}" if joint else ""
        text = re.sub(r"\b(?:and|or) (?=(?:and|or|unless) )", "", " ".join(result.split()).replace("\0", " "))
        return re.sub(r"^(?:and|or|but) |(?: and| or| but)+$", "", text.replace("( ", "(").replace(" )", ")"))

    def _part(self, part: str, following: str, joint: str) -> str:
        """Add the omitted subject and object to a part of a condition."""
        part = PATTERNS["inverted"].sub(r"\2 \1 ", part)
        relation, copula = RELATION.search(part), PATTERNS["stays"].search(part)
        start = min((match.start() for match in (relation, copula) if match), default=0)
        head = re.fullmatch(r"((?:not|if|when) )?(.*?)( ?\bnot)? *", part[:start], re.IGNORECASE)
        if head is None or (relation is None and copula is None):
            return part
        before, subject, denied = (each or "" for each in head.groups())
        rest = f"{denied} {part[start:]}".strip()
        if copula is not None and not (relation and relation.start() < copula.start()):
            rest = PATTERNS["stays"].sub(lambda match: _plain(match[0]), rest, count=1)
        elif not subject:
            rest, before = f"is {before}{rest}", ""
        if not subject or PATTERNS["pronoun"].fullmatch(subject):
            is_hand = PATTERNS["hand"].fullmatch(subject) or not self.subject
            subject = "the gripper" if is_hand else self.subject
        if relation is None:
            if copula is None or part[copula.end() :].strip() not in ("", "not"):
                return part
            self.subject = subject  # "the gripper is neither ... nor ..."
            return "not" if re.search(r"\bnot\b|n't", part) else ""
        previous, self.subject = self.subject, subject[0].lower() + subject[1:]
        if previous and "gripper" not in previous and previous != self.subject and re.search(r"\b(?:it|them)$", rest):
            self.object = previous  # "the puck is pushed if the gripper is near it"
        return f"{before}{subject} {self._with_object(rest, relation[0], following, joint)}"

    def _with_object(self, rest: str, relation: str, following: str, joint: str) -> str:
        """Complete the end of a part, such as "is not above" or "is above it", with the object."""
        before, _, after = rest.rpartition(relation)
        tail = re.sub(r"^(?:with|to|of|from|the top of)\s+", "", after.strip())
        if not tail and relation.lower() in STATES:
            return rest
        if not tail and relation == "aligned":
            return f"{before}{self.aligned or relation}"
        if not tail and relation.endswith("aligned"):
            relation += " with"
        if not tail and joint in ("or", "nor", "and") and not PATTERNS["stays"].search(following):
            other = RELATION.search(following)  # "neither near nor above the mug"
            tail = after = re.sub(r"^(?:with|to|of|from)\s+", "", following[other.end() :].strip()) if other else ""
        if not tail or PATTERNS["pronoun"].fullmatch(tail):
            known = next((each for each in (self.object, self.held) if each and each != self.subject), "")
            after = f"{after[: len(after) - len(tail)]} {known}" if known else after
        elif match := re.match(r"(?:the )?[\w' -]+", tail):
            self.object = match[0].strip()
        rest = " ".join(f"{before} {relation} {after}".split())
        aligned = re.search(r"(?:\w+ly )?aligned with .+", rest)
        self.aligned = aligned[0] if aligned else self.aligned
        return rest

    def acted(self, text: str) -> None:
        """Remember the object of an action, since "it" in a condition after the action refers to that object."""
        if match := PATTERNS["acted"].match(text):
            self.subject = match[1]
            others = PATTERNS["noun"].findall(text[match.end(1) :])
            self.object = others[-1] if others else self.object

    def action(self, text: str, is_first: bool) -> str:
        """Replace "it" in an action, and add the object to a bare "close" or "open"."""
        subject = self.subject.replace("\\", "")
        if text.lower() in ("close", "open"):
            text += f" {subject or 'the gripper'}"
        acted = match[1] if (match := PATTERNS["acted"].match(text)) else subject or "the gripper"
        text = re.sub(r"\buntil it(?= (?:is|isn't)\b)", f"until {acted}", text)
        if subject and is_first:
            moves_gripper = re.match(r"(?:open|close|move|lower|raise)\b", text, re.IGNORECASE)
            it = self.held if "gripper" in subject and self.held and not moves_gripper else subject
            text = re.sub(r"^(\w+) it\b", rf"\g<1> {it}", text)
        if place := PATTERNS["place"].match(text):
            is_near = self.last.kind == "leaf" and f" near {place[2]}" in str(self.last.leaf)
            self.place = f"{'near' if is_near else place[1].lower().replace('to', 'near')} {place[2]}"
        return text


def _plain(copula: str) -> str:
    """Return "is" for "stays" and "is not" for "isn't"; leave "has been" unchanged."""
    return copula if copula.startswith("ha") else "is not" if copula.endswith("n't") else "is"


def _explained(text: str) -> str:
    """Replace words by the explanation in parentheses after them, as in "the puck is held (the gripper is closed)"."""
    text = re.sub(r"\s?\(((?!not\b|no\b|never\b)[^()]*)\)", lambda each: each[0] if _is_known(each[1]) else "", text)
    inside = re.search(r"\w\s*\(([^()]*)\)", text)
    if inside is None or re.search(r"\b(?:not|or|and|is|are|unless)$", text[: inside.start() + 1], re.IGNORECASE):
        return text
    if re.match(r"(?:and|or|but)\b", inside[1]):
        return text.replace(inside[0], f"{inside[0][0]} {inside[1]}")
    before = re.match(r".*\b(?:and|or|but)\s", text[: inside.start()])
    known = before[0] if before and RELATION.search(before[0]) else ""
    return f"{known}({inside[1].rpartition(': ')[2]}){text[inside.end() :]}"


def _is_known(text: str) -> bool:
    return RELATION.search(text) is not None and not text.startswith("see ")


def _affirmed(text: str) -> Expression:
    """Return the condition that "it is" repeats: "near" after "if the gripper is not near the puck"."""
    parts = re.split(r",|(?=\b(?:and|or|nor|but)\b)", text)
    negated = [re.search(r"\b(?:not|\w+n't|nor|neither|far from|without)\b", part) is not None for part in parts]
    return negate(text) if all(negated) else as_expression(text)
