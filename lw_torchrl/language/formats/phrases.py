"""Classify short texts: statements about the scene, commands, and names of objects, relations and verbs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from lw_torchrl.language.formats.base import PROGRAM_WORDS, command, is_near, is_verb, statement, words_of
from lw_torchrl.language.objects import WORDS
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.tasks import TASKS

_NOUNS = frozenset([*(name for task in TASKS.values() for name in task.object_names), *WORDS["canonical"]["hands"]])
_PREPOSITIONS = PROGRAM_WORDS["prepositions"]
_LEADS = re.compile(r"^(?:(?:\w+ly|then|first|next|now|please|just) )+", re.IGNORECASE)
ROLES = {word: role for role, words in PROGRAM_WORDS["keys"].items() for word in words}
"""The roles of keys in JSON and YAML objects."""
_ENDINGS = set(PROGRAM_WORDS["prose"]["endings"])
STRUCTURE = ("test", "loop", "unless", "until", "else", "selector", "sequence")
"""The roles of keys that mark a key-value object as control flow."""


@lru_cache(maxsize=4096)
def plain(text: str) -> str:
    """Return a text or identifier as lower-case words without articles: "IsNear" gives "is near"."""
    words = text.lower().split() if " " in text.strip() else words_of(text.strip(" @!?.$")) or [text]
    words = words[:-1] if len(words) > 1 and words[-1] in ("decorator", "node") else words
    return " ".join(word for word in words if word not in ("the", "a", "an", "robot's"))


@lru_cache(maxsize=4096)
def role_of(key: str) -> str:
    """Return the role of a key in an object, such as "test" for "enter_if"; "" for an unknown key."""
    words = plain(key).split() or [key]
    if role := ROLES.get(" ".join(words)):
        return role
    if len(words) > 1 and words[-1] in ("false", "untrue"):
        return "not"  # "any_false"
    if {"test", "act"} <= {ROLES.get(word) for word in words}:
        return ""  # "condition_action_pairs"
    kinds = [ROLES.get(word) for word in words]
    if 1 < len(words) <= 3 and words[0] != "is" and ("not" in kinds or "unless" in kinds):
        return "not"  # "when_not", "if_none"
    last, first = ROLES.get(words[-1].rstrip("0123456789"), ""), ROLES.get(words[0], "")
    if not _ENDINGS.isdisjoint(words) and (last in ("test", "comment") or words[-1].endswith(("ed", "done"))):
        return "until"  # "complete_when", "achieved"
    if len(words) > 1 and words[-1] in (*PROGRAM_WORDS["prose"]["goals"], "result", "expectation"):
        return "comment"  # "expected_result"
    if last == "name" and first != "act":
        return "name"
    return last if last in (*STRUCTURE, "act", "comment") else first if first in (*STRUCTURE, "act") else ""


def is_aside(key: str) -> bool:
    """Return whether a key, such as "thoughts" or "example_2", has a value that is not a part of the plan."""
    words = plain(key).rstrip("0123456789 ").split()
    return not {" ".join(words), *words[:1], *words[-1:]}.isdisjoint(PROGRAM_WORDS["asides"])


@lru_cache(maxsize=4)
def _relations(predicates: tuple[str, ...]) -> re.Pattern[str]:
    names = {plain(name) for name in (*predicates, *WORDS["conditions"])}
    names |= {re.sub(" (?:with|table)$", "", name) for name in names}
    longest_first = sorted(names, key=len, reverse=True)
    return re.compile(rf"\b(?:{'|'.join(map(re.escape, longest_first))})\b")


def is_predicate(text: str) -> bool:
    """Return whether a text is a relation or a state, such as "is_near"."""
    words = re.sub(r"^(?:(?:is|are|not) )+", "", plain(text))
    return _relations(tuple(PREDICATES)).fullmatch(words) is not None


def is_noun(text: str) -> bool:
    """Return whether a text is the name of an object of some task."""
    return plain(text).removeprefix("of ") in _NOUNS


def is_statement(text: str) -> bool:
    """Return whether a text says something about the scene.

    Example:
        >>> [is_statement(text) for text in ("gripper_near_mug", "Near(gripper, mug)", "open the gripper", "reached")]
        [True, True, False, False]
    """
    if text.endswith("?"):
        return not is_predicate(text)
    if call := re.fullmatch(r"(?:not |!)?([A-Za-z]\w*)\([^()]*\)", text.strip()):
        return is_predicate(call[1]) and not is_verb(plain(call[1]).split())
    words = re.sub(r"[()]", "", plain(statement(text)))
    words = re.sub(r"^(?:(?:not|is|are|if|when|either|both|neither) |!)+", "", words)
    found = _relations(tuple(PREDICATES)).search(words)
    form = re.search(r"\b(?:is|are|isn't|aren't|has been)\b", words)
    before = _LEADS.sub("", words[: min((match.start() for match in (found, form) if match), default=0)]).strip()
    is_subject = is_noun(before) or (form is not None and " " not in before)
    return bool(before) and (is_subject or (" " in text and not is_verb(before.split())))


def is_command(text: str) -> bool:
    """Return whether a text begins with a verb and is not a statement."""
    words = _LEADS.sub("", command(text) if "(" in text else plain(text))
    return is_verb(words.split()) and not is_noun(text) and not is_statement(text)


def is_bare(text: str) -> bool:
    """Return whether a text is a verb without an object, such as "move to" and "move_gripper_above"."""
    words = plain(text).split()
    is_open = len(words) == 1 or {*words[-1:]} <= {*_PREPOSITIONS, *_ANYTHING}
    return is_verb(words) and not is_noun(text) and is_open and (len(words) < 3 or not _ARTICLE.search(text))


def is_told(text: str) -> bool:
    """Return whether a text is a condition or an action by itself, not a name."""
    return (
        is_statement(text) or plain(text) in PROGRAM_WORDS["prose"]["ends"] or (is_command(text) and not is_bare(text))
    )


_WORDS = {name: frozenset(words) for name, words in PROGRAM_WORDS["phrases"].items()}


def truth_of(value: Any) -> bool | None:
    """Return the truth of a boolean in JSON, YAML or Python; None for other values."""
    text = str(value).lower()
    return True if text in _WORDS["true"] else False if text in _WORDS["false"] else None


_COMPARATORS = frozenset().union(*(_WORDS[name] for name in ("equals", "differs", "near", "far")))
_ANYTHING = ("object", "obj", "item", "thing", "entity")  # placeholders for an argument in the name of a skill
_ARTICLE = re.compile(r"\b(?:the|an?)\b")


def is_comparator(value: Any) -> bool:
    """Return whether a value is a comparison operator or phrase, such as "!=" or "at most"."""
    text = value.lower() if isinstance(value, str) else ""
    return text in _COMPARATORS and not is_predicate(text)


class Phrase(NamedTuple):
    """A condition or an action that was joined from names."""

    text: str
    verb: str = ""  # "" for a condition
    is_negated: bool = False


def join_phrase(value: Any, hint: str, names: Mapping[str, Any]) -> Phrase | None:
    """Join names of objects, relations and verbs into a condition or an action; return None for any other value.

    Args:
        hint: "test" for a condition, "act" for an action, "" to infer it from the content.
        names: the definitions in the program, by name.

    Example:
        >>> join_phrase({"subject": "gripper", "relation": "near", "object": "mug"}, "", {}).text
        'gripper near mug'
        >>> join_phrase({"fn": "move_to", "args": ["gripper", "mug"]}, "act", {}).text
        'move gripper to mug'
    """
    row = value if isinstance(value, dict) else {}
    has_name = not any(isinstance(each, str) and role_of(str(key)) == "act" for key, each in row.items())
    if not hint and any(plain(str(key)) in _WORDS["relates"] for key in row):
        hint = "test"  # {"is": "open", "a": "gripper"}
    pieces, negated = list[tuple[int, str, str]](), False  # (rank, role, text)
    stack: list[tuple[str, Any, int, str]] = [("", value, 1, "")]
    while stack:
        key, each, rank, role = stack.pop()
        written = each.lower() if isinstance(each, str) else ""
        text = " ".join(words_of(each.strip("?"))) if written and " " not in each else each
        truth = None if str(each) in names else truth_of(each)
        words = "distance" if plain(key).split()[:1] == ["distance"] else plain(key)
        role = "" if is_comparator(each) else role_of(key) if key else role
        is_sign = words in _WORDS["far"] or words in _WORDS["near"] or words == "distance"
        is_label = role in ("name", "type", "comment", "memory") and not _is_core(text, role, hint, has_name)
        if is_label and not (role == "comment" and is_noun(str(each))):
            continue
        if re.fullmatch(r"[-\d.]+", str(each)) and not is_sign:
            continue
        if (role in STRUCTURE and not isinstance(each, str)) or (role == "not" and isinstance(each, dict)):
            return None
        rank = 0 if words in _WORDS["first"] else 2 if words in _WORDS["second"] else rank
        words = words.removesuffix(" state")
        is_verb_key = role == "" and is_verb(words.split())
        is_title = is_verb_key or (role == "" and bool(written) and " " not in each and is_command(text))
        if key and is_title and not has_name:
            continue  # {"step": "reach_for_mug", "skill": "move_to", ...}
        if is_piece := bool(key) and (is_sign or is_predicate(words) or is_noun(words) or is_verb_key):
            pieces.append((1, "", words))
        is_list = bool(key) and isinstance(each, list) and not is_predicate(words)
        is_not = role == "not" and is_list and not any(is_told(str(part)) for part in each)
        if is_not and len(row) > 1:
            return None
        is_other = bool(key) and written in _WORDS["differs"]
        negated ^= words == "is not" or is_not or is_other or (truth is False and (is_piece or rank == 2))
        if key and (is_other or written in _WORDS["equals"]):
            continue
        if isinstance(each, dict):
            if any(is_statement(str(name)) for name in each):
                return None
            stack += [(str(name), part, rank, "") for name, part in reversed(each.items())]
        elif isinstance(each, list):
            if not all(isinstance(part, str | int | float) for part in each):
                return None
            stack += [("", part, rank, role) for part in reversed(each)]
        elif isinstance(each, str) and truth is None:
            alias = names.get(each, text)
            alias = alias.removesuffix(".state") if isinstance(alias, str) else ""
            if not alias.strip():
                return None
            if alias.split()[0] not in _PREPOSITIONS and not is_piece:
                has_noun = any(not is_bare(other) for *_, other in pieces) and not is_predicate(alias)
                before = words if words in _PREPOSITIONS else "to" if rank == 2 and has_noun and words != "b" else ""
                alias = f"{before} {alias}".strip()
            is_skill = role in ("name", "type") and (is_bare(alias) or (hint == "act" and is_command(alias)))
            pieces.append((rank, "act" if is_skill else role, alias))
    return _joined_pieces(sorted(pieces, key=lambda piece: piece[0]), hint, negated)


def _is_core(text: Any, role: str, hint: str, has_name: bool) -> bool:
    """Return whether a name or type is the verb or the relation: {"type": "action", "name": "move_to", ...}."""
    is_kind = role == "type"
    if (
        not isinstance(text, str)
        or role not in ("name", "type")
        or (is_kind and role_of(text) and not is_predicate(text))
    ):
        return False
    if (hint == "test" or is_kind) and is_predicate(text):
        return True
    is_skill = is_bare(text) or (has_name and hint == "act" and is_command(text))
    return hint != "test" and bool(hint or is_kind) and is_skill


def _joined_pieces(pieces: list[tuple[int, str, str]], hint: str, negated: bool) -> Phrase | None:
    texts = [text for *_, text in pieces]
    skills = [text for _, role, text in pieces if role == "act" and is_command(text)]
    others = [text.split()[-1] for text in texts if text not in skills]
    is_call = len(skills) == 1 and bool(others) and not any(map(is_told, texts[1:])) and not _ARTICLE.search(skills[0])
    named = next((text for text in skills if is_bare(text) or is_call), "")
    verb = named or (texts[0] if texts and is_bare(texts[0]) and hint != "test" else "")
    told = [(role, text) for _, role, text in pieces if text.split()[0] not in _PREPOSITIONS and is_told(text)]
    if any(text != verb and (not verb or role == "act" or (is_command(text) and not named)) for role, text in told):
        return None
    if not named and hint == "" and is_predicate(verb) and sum(map(is_predicate, texts)) > 1:
        return None
    if verb and hint != "test":
        texts.remove(verb)
        first, *after = verb.split()
        if len(after) > 1 or (after and after[0] not in _PREPOSITIONS):
            return Phrase(_called(verb, texts), verb)
        if not after and len(texts) > 1 and is_noun(texts[-1]) and is_noun(texts[-2]):
            texts[-1] = f"to {texts[-1]}"
        moved = texts[:1] if after and len(texts) > 1 else []  # "move to", "gripper", "mug"
        if moved:
            texts[1] = texts[1].removeprefix("to ")
        text = " ".join([first, *moved, *after, *texts[len(moved) :]])
        return Phrase(text.replace("to to ", "to "), verb)
    relation = next((text for text in texts if is_predicate(text) or text in ("distance", "dist")), "")
    if not relation or hint == "act":
        return None
    texts.remove(relation)
    is_distance = relation.startswith("dist")
    negated ^= is_distance and not _WORDS["far"].isdisjoint(texts)
    objects = [re.sub(r"^(?:of|to|is|from) ", "", text) for text in texts if text not in _WORDS["far"] | _WORDS["near"]]
    if any(map(is_predicate, objects)):
        return None
    words = [*objects[:1], "near" if is_distance else relation, *objects[1:]]
    return Phrase(" ".join(words), is_negated=negated)


def comparison_of(row: Mapping[Any, Any]) -> tuple[str, bool] | None:
    """Return the statement that an object compares with a truth value or a distance, and whether it is negated.

    Example:
        >>> comparison_of({"lhs": "distance(gripper, mug)", "op": ">", "rhs": 0.05})
        ('gripper near mug', True)
        >>> comparison_of({"left": "gripper.open", "op": "!=", "right": True})
        ('gripper open', True)
    """
    cells = [
        (str(key), str(each).lower())
        for key, each in row.items()
        if is_comparator(each) or role_of(str(key)) not in ("name", "comment", "type")
    ]
    signs, said, negated = {text for _, text in cells if is_comparator(text)}, list[str](), False
    if not signs or any(isinstance(each, dict | list) for each in row.values()):
        return None
    negated = not _WORDS["differs"].isdisjoint(signs)
    for key, text in cells:
        if distance := re.fullmatch(r"dist\w*\(\s*([^,]+?)\s*,\s*([^,]+?)\s*\)", text):
            negated ^= not _WORDS["far"].isdisjoint(signs)
            lengths = [each for _, each in cells if re.fullmatch(r"\d*\.?\d+", each) and not is_near(float(each))]
            said.append(" ".join([f"{distance[1]} near {distance[2]}", *(f"within {each} m" for each in lengths)]))
        elif (truth := truth_of(text)) is not None:
            negated ^= truth == (role_of(key) == "not")
        elif not re.fullmatch(r"[-\d.]+", text) and text not in signs:
            said.append(text.replace(".", " ") if re.fullmatch(r"\w+\.\w+", text) else text)
    return (said[0], negated) if len(said) == 1 and is_statement(said[0]) else None


def _called(verb: str, texts: list[str]) -> str:
    """Join a skill's name with its arguments: "move gripper above" and "wall", or "push object to" and two names."""
    first, *words = verb.split()
    texts = [text for text in texts if not {*text.removeprefix("to ").split()} <= {*words}]
    if texts and (place := next((number for number, word in enumerate(words) if word in _ANYTHING), -1)) >= 0:
        words[place] = texts.pop(0).removeprefix("to ")
    if texts and words[-1] in _PREPOSITIONS:
        texts[0] = re.sub(rf"^(?:{'|'.join(_PREPOSITIONS)}) ", "", texts[0])
    elif texts and texts[0].split()[0] not in _PREPOSITIONS:
        texts[0] = f"to {texts[0]}" if is_noun(texts[0]) else texts[0]
    return " ".join([first, *words, *texts])
