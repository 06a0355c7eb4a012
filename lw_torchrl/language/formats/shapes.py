"""Convert values of JSON, YAML and XML to the few shapes that :mod:`.trees` can read.

Tables with a header, flowcharts, rows with priorities, rules in strings and JSON in strings become lists and objects.
The fields of an object are classified as tests, goals, facts, programs, definitions or answers.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any

from lw_torchrl.language.formats.base import PROGRAM_WORDS
from lw_torchrl.language.formats.phrases import (
    ROLES,
    STRUCTURE,
    is_bare,
    is_command,
    is_comparator,
    is_noun,
    is_predicate,
    is_statement,
    is_told,
    plain,
    role_of,
    truth_of,
)
from lw_torchrl.language.formats.values import parse_value
from lw_torchrl.language.relations import PREDICATES

MOST_VALUES, MOST_DEPTH = 20_000, 200  # YAML's references can repeat a value
_MOST_FIELDS = 30  # maximum number of fields of an object with a table and its header
RULE = re.compile(
    r"if (.+?),? then (.+?)(?:[,;]? (?:else|otherwise),? (.+))?|(.+?)\s*(?:->|=>|→)\s*(.+)", re.IGNORECASE
)
_OTHERWISE = re.compile(r"(?:else|otherwise|default)\b.+", re.IGNORECASE)
_KINDS = {word for words in PROGRAM_WORDS["types"].values() for word in words}
_KINDS |= {word for word, role in ROLES.items() if role in ("selector", "sequence", "not", "memory", "loop")}
_LABEL = re.compile(r"([A-Za-z]+):\s+([^\n]+)")
_SKILL = re.compile(r"(?:skills?|actions?|primitives?|robot)[/.:]([a-z]\w*)", re.IGNORECASE)
_WORDS = {name: frozenset(words) for name, words in PROGRAM_WORDS["shapes"].items()}


def usual_shape(value: Any) -> Any:
    """Convert a value to a shape that :mod:`.trees` can read.

    Raises:
        ValueError: the value contains more than 20,000 values, or is nested more than 200 levels deep.

    Example:
        >>> usual_shape({"inputs": ["gripper open"], "table": [["F", "open the gripper"], ["T", "move to the mug"]]})
        {'table': [{'gripper open': 'F', 'then': 'open the gripper'}, {'gripper open': 'T', 'then': 'move to the mug'}]}
        >>> usual_shape(["gripper open", "->", "close the gripper"])
        {'if': ['gripper open'], 'then': ['close the gripper']}
    """
    count = itertools.count()

    def usual(each: Any, depth: int) -> Any:
        if next(count) > MOST_VALUES or depth > MOST_DEPTH:
            raise ValueError("too many values")
        if isinstance(each, dict):
            row = {key: usual(part, depth + 1) for key, part in each.items()}
            if len(row) == 1 and (unwrapped := _unwrapped(*next(iter(row.items())))) is not None:
                return unwrapped
            if rules := _from_rules(row):
                return rules
            row = _with_action(row)
            return _chained(_from_flowchart(_without_header(row)) if len(row) < _MOST_FIELDS else row)
        if isinstance(each, list):
            return _listed([usual(part, depth + 1) for part in each])
        return _from_text(each, usual, depth) if isinstance(each, str) else each

    value = usual(value, 0)
    kinds = dict[str, list[str]]()
    for _, row in values_in(value):
        for key, each in row.items() if isinstance(row, dict) else ():
            kinds.setdefault(str(key), []).append(plain(each) if isinstance(each, str) else "")
    types = {key for key, texts in kinds.items() if len({*texts}) > 1 and {*texts} <= _KINDS and role_of(key) == ""}
    return _renamed(value, types) if types else value


def _renamed(value: Any, types: Collection[str]) -> Any:
    """Rename the keys of types, such as "k" in {"k": "sequence", ...}, to "type"."""
    if isinstance(value, dict):
        return {"type" if str(key) in types else key: _renamed(each, types) for key, each in value.items()}
    return [_renamed(each, types) for each in value] if isinstance(value, list) else value


def texts_in(value: Any) -> Iterator[tuple[str, str]]:
    """Yield each text in a value with its key."""
    for key, each in values_in(value):
        if isinstance(each, str) or (type(each) is int and role_of(key) == ""):
            yield key, str(each).strip(" \n${}")


def values_in(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield a value and all values in it, each with its key."""
    stack = [("", value)]
    for key, each in stack:  # the stack grows during the loop
        yield key, each
        if isinstance(each, dict | list) and len(stack) < MOST_VALUES:
            pairs = each.items() if isinstance(each, dict) else ((key, part) for part in each)
            stack += [(str(name), part) for name, part in pairs]


def has_action(value: Any) -> bool:
    """Return whether a value contains an action."""
    rows = value.items() if isinstance(value, dict) else ()
    if any(role_of(str(key)) == "act" and (is_bare(str(each)) or not is_predicate(str(each))) for key, each in rows):
        return True
    said = [text for key, text in texts_in([value]) if role_of(key) not in ("name", "comment")]
    return any(is_told(text) and is_command(text) and not is_predicate(text.split("(")[0]) for text in said)


def states(value: Any) -> bool:
    """Return whether a value says something about the scene."""
    pairs = [pair for pair in values_in(value) if role_of(pair[0]) not in ("name", "comment", "act")]
    said = [each for _, each in pairs if isinstance(each, str)]
    said += [str(key) for _, each in pairs if isinstance(each, dict) for key in each]
    return any(is_statement(text) or is_predicate(text.split("(")[0]) for text in said)


def mentions(value: Any, names: Collection[str]) -> bool:
    """Return whether a value contains one of the names, as a text or as a key."""
    keys = value if isinstance(value, dict) else ()
    said = [text for key, text in texts_in([value]) if role_of(key) not in ("type", "act")]
    return any(str(key) in names for key in keys) or any(text in names for text in said)


def is_facts(value: Any) -> bool:
    """Return whether a JSON object states facts: {"near": ["gripper", "mug"], "gripper": "closed"}."""
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


def is_reserved(name: str, value: Any) -> bool:
    """Return whether a name already has a meaning, as a keyword, object or predicate, and cannot be defined."""
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


def names_of(rows: list[Any], counts: Counter[str], fields: Counter[tuple[str, str]]) -> list[str]:
    """Return the name of each row of a list: the field that other values refer to, or the row's number."""
    objects = [row if isinstance(row, dict) else {} for row in rows]
    lists = [each for row in objects for each in row.values() if isinstance(each, list)]
    numbers = [part for each in lists if all(type(part) is int for part in each) for part in each]
    keys = dict.fromkeys(str(key) for row in objects for key, each in row.items() if isinstance(each, str | int))
    best, best_count = [""] * len(rows), 0
    for key in keys:
        if role_of(key) != "name" and (len(rows) == 1 or role_of(key) or key in ("from", "source")):
            continue
        names = [str(row.get(key, "")) for row in objects]
        named = [name for name in names if name]
        referred = sum(counts[name] > fields[key, name] * (role_of(key) != "name") for name in named)
        if len({*named}) == len(named) and referred > best_count and not any(map(is_told, named)):
            best, best_count = names, referred
    is_numbered = numbers and all(0 <= number < len(rows) for number in numbers)
    return [str(number) for number in range(len(rows))] if not best_count and is_numbered else best


def _unwrapped(key: Any, value: Any) -> Any:
    """Convert {"var": "x"} to "x" and {"<": ["x", 1]} to an object with two sides; None for other values."""
    if str(key) in ("var", "variable", "$ref", "const") and isinstance(value, str):
        return value
    if is_comparator(key) and isinstance(value, list) and len(value) == 2:
        return {"left": value[0], "op": key, "right": value[1]}
    return None


def _from_text(text: str, usual: Any, depth: int) -> Any:
    """Return the JSON value, rules, skill or labelled text that a text consists of; otherwise the text itself."""
    inner = text.strip()
    if skill := _SKILL.fullmatch(inner):
        return skill[1]
    if inner[:1] in ("{", "[") and inner[-1] in "}]" and re.search("[\"':]", inner):
        value = parse_value(inner)
        return usual(value, depth + 1) if isinstance(value, dict | list) and value else text
    if (label := _LABEL.fullmatch(inner)) and role_of(label[1]) in ("test", "act", "unless", "else"):
        return {label[1]: label[2]}  # "Condition: the gripper is open"
    lines = [line.strip() for line in inner.splitlines() if line.strip()]
    is_rules = len(lines) > 1 and sum(bool(RULE.fullmatch(line) or _OTHERWISE.fullmatch(line)) for line in lines) > 1
    return usual(lines, depth + 1) if is_rules else text


def _listed(rows: list[Any]) -> Any:
    """Convert a list with arrows, pairs or a header to objects with rules, and put the most urgent rules first."""
    arrow = next((number for number, each in enumerate(rows) if isinstance(each, str) and each in _WORDS["arrows"]), 0)
    if arrow and arrow + 1 < len(rows):
        return {"if": rows[:arrow], "then": rows[arrow + 1 :]}
    pairs = [each for each in rows[1:] if isinstance(each, list) and len(each) == 2]
    is_cases = len(pairs) == len(rows) - 1 > 1 and isinstance(rows[0], str) and role_of(rows[0]) == "test"
    if is_cases and all(isinstance(test, list | dict) or is_statement(str(test)) for test, _ in pairs[:-1]):
        return [{"if": test, "then": action} for test, action in pairs]  # ["cond", [test, action], ...]
    is_table = len(rows) > 1 and all(isinstance(each, list) and [*map(type, each)] == [str, str] for each in rows)
    if is_table and any(is_statement(test) and is_command(action) for test, action in rows):
        return [{role_of(test) or "if": test, "then": action} for test, action in rows]
    if len(rows) > 1 and all(isinstance(each, dict) for each in rows):
        return _by_urgency(rows)
    return _zipped(rows[0], rows[1:]) or rows if len(rows) > 1 else rows


def _from_rules(row: dict[Any, Any]) -> list[dict[Any, Any]]:
    """Convert {condition: action, ...} to a list of rules if a condition is unknown and would be read as a title."""
    others = [str(key) for key in row if not is_statement(str(key))]
    is_strange = any(" " in key.strip() and not role_of(key) and not is_told(key) for key in others)
    if len(row) < 2 or len(others) == len(row) or not is_strange:
        return []
    if not all(isinstance(each, str) and is_command(each) for each in row.values()):
        return []
    return [{key: each} if role_of(str(key)) else {"if": key, "then": each} for key, each in row.items()]


def _with_action(row: dict[Any, Any]) -> dict[Any, Any]:
    """Rename "name" to "action" if it holds an action, beside conditions: {"name": "push the door", "pre": ...}."""
    texts = [str(each) for key, each in row.items() if role_of(str(key)) == "name"]
    names = [text for text in texts if is_command(text) and is_told(text)]
    others = {key: each for key, each in row.items() if role_of(str(key)) != "name" or str(each) not in names}
    if len(names) != 1 or has_action(others) or not any(role_of(str(key)) == "test" for key in others):
        return row
    return {key if key in others else "action": each for key, each in row.items()}


def _by_urgency(rows: list[dict[Any, Any]]) -> list[dict[Any, Any]]:
    """Sort rows by priority; reverse them if a row without a condition would come first and hide the others."""
    for key in rows[0]:
        cells = [str(row.get(key)) for row in rows]
        if len({*cells}) < len(rows) or not all(re.fullmatch(r"-?\d+(\.\d+)?", cell) for cell in cells):
            continue
        order = sorted(rows, key=lambda row: float(row[key]))
        if _WORDS["urgent"].isdisjoint(plain(str(key)).split()):
            order = order if rows != order[::-1] else rows
        elif rows in (order, order[::-1]):
            order = rows
        else:
            order.reverse()
        is_free = [not states(row) for row in order]
        return order[::-1] if is_free[0] and not is_free[-1] else order
    return rows


def _without_header(row: dict[Any, Any]) -> dict[Any, Any]:
    """Convert a table whose header is in a separate field: each row becomes an object with the header as keys."""
    for name, header in row.items():
        for key, table in row.items():
            if isinstance(header, list) and isinstance(table, list) and (rows := _zipped(header, table)):
                return {each: rows if each == key else part for each, part in row.items() if each != name}
    return row


def _zipped(header: Any, table: list[Any]) -> list[Any] | None:
    if not isinstance(header, list) or not all(isinstance(each, str) for each in header) or not table:
        return None
    if not all(isinstance(row, list) and 0 <= len(row) - len(header) <= 1 for row in table):
        return None
    rows = [dict(zip([*header, "then"], map(_cell, row), strict=False)) for row in table]
    facts = [name for name in header if is_statement(name)]
    cells = [row[name] for row in rows for name in facts]
    is_table = facts and all(truth_of(cell) is not None or str(cell) in "-*" for cell in cells)
    return rows if is_table or {"test", "act"} <= {role_of(each) for each in header} else None


def _cell(value: Any) -> Any:
    text = str(value).lower()
    return True if text in _WORDS["marked"] else False if text in _WORDS["unmarked"] else value


def _chained(row: dict[Any, Any]) -> dict[Any, Any]:
    """Convert {"if": [test, action, test, action, ..., action]} to nested branches."""
    for key, parts in row.items():
        is_chain = role_of(str(key)) == "test" and isinstance(parts, list) and len(parts) > 2
        if is_chain and not any(map(has_action, parts[:-1:2])) and all(map(has_action, parts[1::2])):
            rest: Any = parts[-1] if len(parts) % 2 else None
            for test, action in reversed([*zip(parts[:-1:2], parts[1::2], strict=False)]):
                rest = {"if": test, "then": action, "else": rest}
            return {**{name: each for name, each in row.items() if name != key}, **rest}
    return row


def _from_flowchart(row: dict[Any, Any]) -> dict[Any, Any]:
    """Convert a flowchart, with a list of edges and their answers "yes" and "no", to objects that name each other."""
    for name, nodes in row.items():
        pairs = nodes.items() if isinstance(nodes, dict) else enumerate(nodes if isinstance(nodes, list) else ())
        table = {
            str(each.get("id", each.get("name", key)) if isinstance(each, dict) else key): each for key, each in pairs
        }
        for other, edges in row.items():
            if other == name or not isinstance(edges, list) or not all(isinstance(each, dict | list) for each in edges):
                continue
            branches = dict[str, dict[str, Any]]()
            for edge in edges:
                cells = [str(each) for each in (edge.values() if isinstance(edge, dict) else edge)]
                ends, truths = [cell for cell in cells if cell in table], {*map(truth_of, cells)} - {None}
                if len(ends) == 2 and truths:
                    branch = branches.setdefault(ends[0], {"if": table[ends[0]]})
                    branch["then" if True in truths else "else"] = ends[1]
            if branches:
                targets = [branch.get(key) for branch in branches.values() for key in ("then", "else")]
                first = next((key for key in branches if key not in targets), next(iter(branches)))
                rest = {key: each for key, each in row.items() if key not in (name, other)}
                return {**rest, "entry": first, "nodes": table | branches}
    return row
