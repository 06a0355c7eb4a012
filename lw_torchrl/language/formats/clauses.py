"""Split prose into clauses, and find the connective and the kind of each clause (condition, action, state, ...)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from lw_torchrl.language.formats.base import PROGRAM_WORDS, is_verb
from lw_torchrl.language.formats.phrases import is_noun
from lw_torchrl.language.objects import WORDS
from lw_torchrl.language.relations import RELATIONS

_WORDS = PROGRAM_WORDS["prose"]
_ROBOT = re.compile(r"(?:then )?(?:the )?robot (?:should|must|has to|needs to) ", re.IGNORECASE)
_NO_ACTS = frozenset((*_WORDS["looks"], *_WORDS["no_verbs"], *PROGRAM_WORDS["prepositions"]))


def _any(words: list[str]) -> str:
    return f"(?:{'|'.join(words)})"


def _compiled(pattern: str) -> re.Pattern[str]:
    return re.compile(pattern, re.IGNORECASE)


_PARTS = {name: _any(words) for name, words in _WORDS["parts"].items()}
_PARTS["motion"] = _any([word for word in PROGRAM_WORDS["motions"] if word != "open"])
_PARTS |= {name: _any(_WORDS[name]) for name in ("leads", "urges", "asks", "ends", "announces")}
_PARTS |= {f"connective_{role}": _any(words) for role, words in _WORDS["connectives"].items()}
_PARTS |= {f"answer_{role}": _any(words) for role, words in _WORDS["answers"].items()}
_RELATED = sorted([*RELATIONS, *({*WORDS["conditions"]} - {"on", "at"})], key=len, reverse=True)
_PARTS["relation"] = _any(list(map(re.escape, _RELATED)))
PATTERNS = {  # a name in angle brackets stands for an entry of _PARTS
    name: _compiled(re.sub(r"<(\w+)>", lambda part: _PARTS.get(part[1], part[0]), pattern))
    for name, pattern in _WORDS["patterns"].items()
}
RELATION, _LEAD, _JOINT, _IS_MODAL = (PATTERNS[name] for name in ("relation", "lead", "joint", "is_modal"))
_CONNECTIVES = {role: _compiled(_any(words) + r"\b") for role, words in _WORDS["connectives"].items()}
_ANSWERS = {
    role: _compiled(_any(words) + (r"\b" if role in ("else", "rest", "case") else PATTERNS["end"].pattern))
    for role, words in _WORDS["answers"].items()
}
STATES = frozenset(("open", "closed", "shut", "held", "grasped", "gripped", "lifted", "touching the table"))
_ADJECTIVES = frozenset(("open", "close", "lower", "level", "back", "clear", "free", "hand", "head", "stick", "wrench"))
_NOUNS = ("the", "it", "its", "your", "them", "gripper")
_AFTER_VERB = (*_NOUNS, "down", "up", "back", *PROGRAM_WORDS["prepositions"])


@dataclass(frozen=True)
class Clause:
    """A part of a sentence, and the connective before it."""

    kind: str  # a connective ("if", "unless", "until", "else", ...), "ask", "act", "state" or "say"
    text: str  # without the connective; an action is an imperative
    joint: str = ""  # "and", "or", "but", "then" or "so" before the connective
    stop: str = ""  # the punctuation after the clause
    word: str = ""  # the connective as written
    told: bool = False  # whether an action is written as a statement: "the robot moves ..."


def clauses(text: str) -> list[Clause]:
    """Split a line into clauses.

    Example:
        >>> for clause in clauses("Once the gripper is near the mug and open, close it; otherwise, move above it."):
        ...     print(clause.kind, repr(clause.text), repr(clause.stop))
        if 'the gripper is near the mug and open' ','
        act 'close it' ';'
        else '' ','
        act 'move above it' '.'
    """
    text = re.sub(r"(\w)[.]?\s{2,}\d{1,2}[.)]\s", r"\1. ", text)  # "Steps: 1. ...  2. ..."
    hidden = re.sub(r"\([^()]*\)", lambda inside: inside[0].translate(_HIDE), text)
    sentences = re.split(r"([.;:!?])", hidden)
    for number in range(0, len(sentences) - 1, 2):
        if sentences[number + 1] == "?":
            sentences[number] = sentences[number].replace(",", chr(0xE000))
    hidden = "".join(sentences)
    found, start = list[Clause](), 0
    inner = _begin(hidden)  # position after the connectives
    for match in PATTERNS["cut"].finditer(f"{hidden} "):
        before, rest = hidden[start : match.start()].translate(_SHOW), hidden[match.end() :][:400].translate(_SHOW)
        is_word = not match[0].strip()
        if match.start() < start or (is_word and (match.end() <= inner or not _is_cut(before[-400:], rest))):
            continue
        found += _clause(before.strip(" \"'"), (match[1] or "")[:1] or "," * (not is_word))
        start = match.end()
        inner = start + _begin(hidden[start:])
    if rest := hidden[start:].translate(_SHOW).strip(" \"'"):
        found += _clause(rest, "")
    return found


_HIDE = {ord(mark): 0xE000 + number for number, mark in enumerate(",;:.?!- ")}
_SHOW = {hidden: mark for mark, hidden in _HIDE.items()}


def _begin(text: str) -> int:
    """Return the position in a clause after its connectives."""
    at = 0
    while match := _JOINT.match(text, at) or _LEAD.match(text, at):
        at = match.end()
    patterns = [*_ANSWERS.values(), *_CONNECTIVES.values()]
    match = next((match for pattern in patterns if (match := pattern.match(text, at))), None)
    return match.end() if match else at


def _is_cut(before: str, rest: str) -> bool:
    """Return whether a new clause begins between two parts of a phrase that no punctuation separates."""
    joint = _JOINT.match(rest)
    inner = rest[joint.end() :] if joint else rest
    while joint and (lead := _LEAD.match(inner)):
        inner = inner[lead.end() :]
    first = before.strip().lower()
    first = first[joint_before.end() :] if (joint_before := _JOINT.match(first)) else first
    if PATTERNS["thing"].search(first) and inner.lower().startswith("else"):
        return False
    if PATTERNS["repeats"].match(first) or PATTERNS["asks"].match(f"{first} if it"):
        return joint is not None and (is_action(inner) or PATTERNS["asks"].match(inner) is not None)
    if _CONNECTIVES["until"].match(inner):
        return joint is not None and bool(action(before))
    if _CONNECTIVES["reason"].match(inner) or any(pattern.match(inner) for pattern in _ANSWERS.values()):
        return True
    if gerund := PATTERNS["after"].match(inner):
        return bool(action(before) and base_verb(gerund[1]))
    if word := _CONNECTIVES["if"].match(inner) or _CONNECTIVES["unless"].match(inner):
        return not PATTERNS["no_cut"].match(word[0]) and not PATTERNS["doing"].match(inner[word.end() :])
    if joint is None or (PATTERNS["purpose"].search(before) and not action(before)):
        return False
    if PATTERNS["plain_if"].match(first):  # "if the gripper is near the mug and open"
        return joint[1].lower() == "then" or is_action(inner)
    if PATTERNS["forbids"].search(first) and joint[1].lower() in ("and", "or"):  # "do not hit the wall or drop the mug"
        return False
    if joint[1].lower() == "and" and action(before) and inner.split()[0].lower() not in PROGRAM_WORDS["motions"]:
        return False  # "move it to the mug and hook it" is one action
    is_result = joint[1].lower() in ("so", "then") and bool(action(inner))
    return is_result or is_action(inner) or bool(PATTERNS["asks"].match(inner))


def _clause(text: str, stop: str) -> Iterator[Clause]:
    """Yield the clauses of a piece of a line: leading words such as "otherwise" or "yes", then the rest."""
    joint = ""
    while text:
        if match := _JOINT.match(text):
            joint, text = match[1].lower().rpartition(" ")[2], text[match.end() :]
            continue
        role, match = next(
            ((role, match) for role, pattern in _ANSWERS.items() if (match := pattern.match(text))), ("", None)
        )
        if match is not None:
            text = text[match.end() :].lstrip(" ,:?")
            yield Clause(role, "", joint, "" if text else stop, match[0])
            joint = ""
            if not text:
                return
            continue
        if match := _LEAD.match(text):
            orders = match[0].lower().startswith(("then", "first", "second", "third", "next", "finally", "last"))
            text, joint = text[match.end() :], joint or "then" * orders
            continue
        break
    if not text:
        yield Clause("say", "", joint, stop)
        return
    for role, pattern in _CONNECTIVES.items():
        if (match := pattern.match(text)) and (text[match.end() :].strip() or role == "reason"):
            yield from _subordinate(role, match[0].lower(), text[match.end() :].strip(), joint, stop)
            return
    yield replace(_main(text, stop), joint=joint)


def _subordinate(role: str, word: str, text: str, joint: str, stop: str) -> Iterator[Clause]:
    """Yield the clause after a connective, and an action that follows without a comma ("if it is open close it")."""
    gerund = re.match(r"(\w+ing)\b(.*)", text)
    if word in ("after", "before", "once", "when", "while") and gerund and base_verb(gerund[1]):
        kind = word if word in ("after", "before") else "say"
        yield Clause(kind, base_verb(gerund[1]) + gerund[2], joint, stop, word)
        return
    if role == "before" or (word in ("with", "where") and not RELATION.search(text)):
        yield Clause("say", f"{word} {text}", joint, stop, word)
        return
    text = re.sub(r"^(.+?) (not )?be ", r"\1 is \2", text) if word in ("with", "should", "where") else text
    text = re.sub(r"[,\s]+then$", "", text, flags=re.IGNORECASE)
    if role in ("if", "unless") and (at := _action_at(text)):
        yield Clause(role, text[:at].strip(), joint, "", word)
        yield _main(text[at:].strip(), stop)
        return
    yield Clause(role, text, joint, stop, word)


def _action_at(text: str) -> int:
    """Return the position of an action that follows a condition without a comma; 0 if there is none."""
    for gap in re.finditer(r"\s+", text[:400]):
        before, rest = text[: gap.start()], text[gap.end() :]
        is_verb_first = PATTERNS["verb_first"].match(rest) and _is_verb(rest.split())
        if not is_verb_first and not (PATTERNS["agent"].match(rest) and action(rest) and not is_state(rest)):
            continue
        if RELATION.search(before) and not PATTERNS["goes_on"].search(before):
            return gap.end()
    return 0


def _main(text: str, stop: str) -> Clause:
    """Convert a text without a connective to a clause of the right kind."""
    if PATTERNS["repeat"].match(text):
        return Clause("say", text, "", stop)
    if match := PATTERNS["asks"].match(text):
        return Clause("ask", match[1] or match[2], "", stop, "check")
    if stop == "?":
        return Clause("ask", text, "", stop)
    if is_state(text):
        return Clause("state", text, "", stop)
    if imperative := action(text):
        told = imperative not in text or (PATTERNS["agent"].match(text) is not None and text[:3].lower() != "you")
        return Clause("act", imperative, "", stop, text, told)
    return Clause("say", text, "", stop)


def is_state(text: str) -> bool:
    """Return whether a clause describes the scene: "the gripper is near the mug", "gripper near mug" or "open"."""
    if _IS_MODAL.search(text) or PATTERNS["must_not"].search(text):
        return False
    if inside := re.search(r" \(([^()]+)\)$", text):  # "the robot has the puck (the gripper is near the puck)"
        return is_state(inside[1].rpartition(": ")[2]) or is_state(text[: inside.start()])
    text = re.sub(r"^(?:(?:not|still|already|now|also|yet) )+", "", text)
    relation, words = RELATION.search(text), text.split()
    if relation is None or PATTERNS["no_state"].match(text):
        return False
    if (inner := PATTERNS["to_do"].search(text)) and _is_verb(inner[1].split()):
        return False  # "it is forbidden to open the gripper"
    if relation.start() == 0:
        is_verb_form = words[0].lower() in ("open", "close", "shut", "touch")
        return not is_verb_form or len(words) == 1 or words[1] in ("and", "or", "but")
    subject, *copula = PATTERNS["copula"].split(text[: relation.start()], maxsplit=1)
    is_closed = PATTERNS["is_closed"].search(text) is not None
    is_named = copula or is_noun(subject.strip()) or re.match(r"(?:the|its|it)\b", text, re.IGNORECASE)
    is_command = _is_verb(words) and words[1:2] and words[1].lower() in _NOUNS
    is_acted = bool(action(text)) and not (_is_verb(words) and is_noun(subject.strip()))
    return bool(is_named) and len(subject.split()) <= 5 and not is_command and (not is_acted or is_closed)


def is_action(text: str) -> bool:
    """Return whether a text begins with an action; "open and near" and "lower than" begin with an adjective."""
    words = action(text).lower().split()
    if not words or _IS_MODAL.match(text):
        return bool(words)
    if len(words) == 1:
        return words[0] in ("stop", "wait", "descend", "halt", "retreat", *_WORDS["ends"])
    return words[0] not in _ADJECTIVES or words[1].strip(",.;:") in (*_NOUNS, "around", "on", "down", "up", "upon")


def action(text: str, is_certain: bool = False) -> str:
    """Return "push it" for "push it", "the robot should push it", "it pushes it" and "it is pushed"; otherwise "".

    With ``is_certain``, "the gripper is closed" gives "close the gripper"; by default, this text is not an action.
    """
    is_told = False
    while match := _LEAD.match(text) or _JOINT.match(text) or PATTERNS["should"].match(text):
        is_told |= _ROBOT.match(text) is not None
        text = text[match.end() :]
    if text.lower() in _WORDS["ends"]:
        return text
    if re.match(r"do (?!nothing|not touch)", text, re.IGNORECASE):
        return ""
    if (match := PATTERNS["is_to"].match(text)) and _is_verb(text[match.end() :].split()):
        text = text[match.end() :]
    if gerund := PATTERNS["gerund"].fullmatch(text):
        verb = base_verb(gerund[1] or gerund[3])
        return f"{verb} {gerund[2] or gerund[4]}" if verb else ""
    words = text.split()
    if _is_verb(words):
        return text if len(words) <= 40 and not re.match(r"\w+ (?:is|are)\b", text) else ""
    is_state = PATTERNS["is_closed"].search(text)
    if (is_certain or not is_state) and (passive := PATTERNS["passive"].match(text)):
        verb = base_verb(passive[3])
        if verb and passive[3].lower() != verb:
            return f"{verb} {passive[1][0].lower()}{passive[1][1:]}{passive[4]}"
    if does := PATTERNS["does"].match(text):
        verbs = (does[1], does[1] + (does[2] or "")[:-1])
        rest = re.sub(r"(?<=\band )\w+s\b(?= )", lambda verb: base_verb(verb[0]) or verb[0], text[does.end() :])
        rest = rest or (" the gripper" if does[1][:4] in ("open", "clos") else "")
        return next((verb + rest for verb in verbs if _is_verb([verb])), "")
    first = text.partition(" ")[0]
    if first.endswith("s") and not first.endswith("ss") and base_verb(first) and words[1:2] and words[1] in _AFTER_VERB:
        return f"{base_verb(first)} {text.partition(' ')[2]}"
    is_act = 1 < len(words) <= 40 and first.isalpha() and first.lower() not in _NO_ACTS
    return text if is_told and is_act and not re.search(r"\b(?:not?|never|without)\b", text) else ""


def _is_verb(words: list[str]) -> bool:
    return is_verb(words) or (bool(words) and words[0].lower() in PROGRAM_WORDS["motions"])


def base_verb(word: str) -> str:
    """Return the verb of a form such as "closing", "closed" or "swept"; "" if there is none."""
    word = word.lower()
    stem = re.sub(r"(?:ing|ed|s)$", "", word)
    forms = (_WORDS["forms"].get(word, ""), stem, stem.removesuffix("e"), f"{stem}e", re.sub(r"(\w)\1$", r"\1", stem))
    return next((verb for verb in forms if verb and _is_verb([verb])), "")
