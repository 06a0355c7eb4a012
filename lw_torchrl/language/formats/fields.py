"""Classify the fields of an object in JSON or YAML: goals, tests, programs, states of a machine, transitions."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from lw_torchrl.language.formats.base import PROGRAM_WORDS
from lw_torchrl.language.formats.phrases import (
    ROLES,
    STRUCTURE,
    is_command,
    is_noun,
    is_predicate,
    is_statement,
    is_told,
    plain,
    role_of,
    truth_of,
)
from lw_torchrl.language.formats.shapes import has_action, mentions, states, texts_in
from lw_torchrl.language.relations import PREDICATES


def transitions_of(value: Any) -> dict[Any, Any]:
    """Return the fields of an object that hold transitions between states."""
    rows = value.items() if isinstance(value, dict) else ()
    return {key: each for key, each in rows if role_of(str(key)) == "transitions"}


def is_facts(value: Any) -> bool:
    """Return whether an object states facts: {"near": ["gripper", "mug"], "gripper": "closed"}."""
    return isinstance(value, dict) and all(
        (is_noun(str(key)) and (isinstance(each, dict) or is_predicate(str(each))))
        or (is_predicate(str(key)) and isinstance(each, list) and len(each) > 1)
        for key, each in value.items()
    )


def is_goal(key: Any) -> bool:
    return plain(str(key)).rpartition(" ")[2] in PROGRAM_WORDS["prose"]["goals"]


def is_test(key: Any, value: Any) -> bool:
    role = role_of(str(key))
    return role == "test" or (role not in ("name", "comment", "act") and states(value) and not has_action(value))


def is_program(key: str, value: Any) -> bool:
    """Return whether the value of a label is a program: {"task": {"if": ..., "then": ...}}."""
    if isinstance(value, dict) and role_of(key) != "comment":
        return True
    rows = [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []
    return any(has_action(row) and any(role_of(str(key)) in STRUCTURE for key in row) for row in rows)


def is_always(text: str) -> bool:
    return text.lower().strip(" .") in PROGRAM_WORDS["always"]


def is_machine(members: list[Any], names: Collection[str]) -> bool:
    """Return whether a transition in a table's members leads to one of the members' names."""
    return any(mentions(value, names) for each in members for value in transitions_of(each).values()) or any(
        text in names and (role_of(key) == "transitions" or is_statement(key)) for key, text in texts_in(members)
    )


def named(value: Any) -> str:
    """Return the name that an object gives itself: {"id": "grasp"}."""
    rows = value.items() if isinstance(value, dict) else ()
    return next((str(each) for key, each in rows if plain(str(key)) in ("id", "name", "key", "state")), "")


def source(value: Any) -> str:
    """Return the name of the state that a transition leaves."""
    if isinstance(value, dict):
        return str(value.get("from", value.get("source", named(value))))
    return str(value[0]) if isinstance(value, list) and value else ""


def is_reserved(name: str, value: Any) -> bool:
    """Return whether a name has another meaning than its definition."""
    is_word = plain(name) in ROLES or is_always(name)
    is_object = is_noun(name) and not any(is_told(text) for _, text in texts_in(value))
    is_relation = plain(name) in PREDICATES and not (isinstance(value, str) and is_told(value))
    return not name or is_word or is_object or is_relation


def is_skipped(row: dict[Any, Any], key: str, value: Any) -> bool:
    """Return whether a field can be ignored: {"else": true}, or definitions, which are read where they are named."""
    if value is None:
        return not is_command(key)
    role = role_of(key)
    is_named = isinstance(value, list) and all(isinstance(each, str) for each in value)  # names of definitions
    return (role == "definitions" and len(row) > 1 and not is_named) or (role == "else" and truth_of(value) is not None)


def is_answer(row: dict[Any, Any]) -> bool:
    """Return whether an object contains the branches of a separate condition: {"true": ..., "false": ...}."""
    roles = {role_of(str(key)) for key in row}
    return "else" in roles and roles <= {"act", "else"}
