"""A reader of programs in JSON and YAML: behaviour trees, rules, state machines and nested choices, with any keys."""

from __future__ import annotations

import ast
import json
import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import FALSE, TRUE, Expression, all_of, any_of, as_expression, negate
from lw_torchrl.language.formats.base import PROGRAM_WORDS, Reading, code_blocks, in_turn, is_verb, words_of
from lw_torchrl.language.programs import (
    Block,
    Branch,
    Check,
    Done,
    Loop,
    Node,
    Selector,
    Sequence,
    actions_of,
    is_condition,
)

_KEYS: Mapping[str, list[str]] = PROGRAM_WORDS["keys"]
_TYPES = {word: kind for kind, words in PROGRAM_WORDS["types"].items() for word in words}
_MOST_VALUES = 20_000  # YAML's references can repeat a value
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|//[^\n]*|/\*.*?\*/|#[^\n]*|[^"\[\]{},/#]+|.', re.DOTALL)
_YAML = re.compile(r"^\s*(?:- )?[\w -]{1,40}:(?:\s|$)", re.MULTILINE)


class TreeReading(Reading):
    """A reader of JSON and YAML. Each fenced block, or the text from the first bracket, is a section with a tree."""

    def __init__(self, text: str) -> None:
        super().__init__()
        for start, block in code_blocks(text):
            value = _json(block)
            value = _yaml(block) if value is None else value
            if not isinstance(value, dict | list):
                continue
            tree = _Tree(self, block, start)
            try:
                node = tree.node(value)
            except (RecursionError, ValueError):
                self.error = "the tree is too large or nests too deeply"
                continue
            is_listing = "{" not in str(value)
            texts = [action.text.split() for action in actions_of(node)]
            if (
                node is not None
                and texts
                and not (is_listing and any(len(words) < 2 or not is_verb(words) for words in texts))
            ):
                self.add_tree("", start + 1, node)


def _json(text: str) -> Any:
    """Parse JSON, with comments, trailing commas and missing brackets; None if the text is not JSON."""
    if (start := re.search(r"[{\[]", text)) is None:
        return None
    text = text[start.start() :]
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    parts, closers = list[str](), list[str]()
    for token in _TOKEN.findall(text):
        if token[:2] in ("//", "/*") or token[0] == "#" or token.isspace():
            continue
        if token in ("]", "}"):
            if not closers:
                break
            closers.pop()
            while parts[-1] == ",":
                parts.pop()
        parts.append(token)
        if token in ("[", "{"):
            closers.append("]" if token == "[" else "}")
        if not closers:
            break
    while closers and parts and not (parts[-1] in "]}[{" or (parts[-1][-1] == '"' and len(parts[-1]) > 1)):
        parts.pop()  # of a value that is cut off
    if len(parts) > 1 and closers and closers[-1] == "}" and parts[-1][-1] == '"' and parts[-2].strip() != ":":
        parts.pop()  # a key without a value
    while parts and parts[-1] == ",":
        parts.pop()
    repaired = "".join([*parts, *reversed(closers)])
    with suppress(ValueError, RecursionError):
        return json.loads(repaired)
    with suppress(ValueError, TypeError, SyntaxError, RecursionError, MemoryError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about invalid escapes in the text
        return ast.literal_eval(repaired)
    return None


def _yaml(text: str) -> Any:
    """Parse YAML without its types; None if the text is not YAML, or if PyYAML is not installed."""
    if len(_YAML.findall(text)) < 2:
        return None
    with suppress(ImportError):
        import yaml  # type: ignore[import-untyped]

        with suppress(yaml.YAMLError, ValueError, RecursionError):
            return yaml.load(text, getattr(yaml, "CBaseLoader", yaml.BaseLoader))
    return None


class _Tree:
    """The conversion of a JSON value to a program."""

    def __init__(self, reading: Reading, text: str, start: int) -> None:
        self.reading, self.text, self.start, self.at, self.count = reading, text, start, 0, 0

    def line(self, text: str) -> int:
        """Return the line of the next occurrence of a text."""
        written = json.dumps(text, ensure_ascii=False)[1:-1]
        found = self.text.find(written, self.at)
        found = self.text.find(written) if found < 0 else found
        self.at = max(self.at, found)
        return self.start + 1 + self.text.count("\n", 0, self.at)

    def node(self, value: Any, is_rule_list: bool = False) -> Node | None:
        """Convert a value to a program, or return None if it has neither actions nor conditions."""
        self.count += 1
        if self.count > _MOST_VALUES:
            raise ValueError("too many values")
        if isinstance(value, str):
            return in_turn(value, self.line(value)) if value.strip() else None
        if isinstance(value, list):
            nodes = [node for each in value if (node := self.node(each)) is not None]
            rules = is_rule_list or any(isinstance(each, Branch) for each in nodes)
            return None if not nodes else Selector(tuple(nodes)) if rules else Sequence(tuple(nodes))
        return self.object(_normal(value)) if isinstance(value, dict) else None

    def object(self, row: dict[str, Any]) -> Node | None:
        kind = _TYPES.get(" ".join(words_of(str(_get(row, "type", "")))))
        memory = kind == "memory" or _is_true(_get(row, "memory"))
        kind = "sequence" if kind == "memory" else kind
        condition, then = _get(row, "condition"), _get(row, "action")
        children = _get(row, "children")
        if (states := _get(row, "states")) is not None:
            return self.object(_normal(states)) if "states" in _normal(states) else self.machine(states, row)
        if kind in ("selector", "sequence", "not") and children is not None:
            parts = tuple(self.children(children))
            if kind == "not" and all(map(is_condition, parts)):
                return Check(negate(all_of(part.condition for part in parts if isinstance(part, Check))))
            return Selector(parts) if kind == "selector" else Sequence(parts, memory)
        if kind == "condition":
            return Check(self.condition(row))
        if kind == "action" or (kind is None and condition is None and isinstance(then, str)):
            return self.until(self.action(row), row)
        for role in ("rules", "sequence", "remembered"):
            if (rules := _get(row, role)) is not None:
                parts = tuple(self.children(rules))
                last = self.node(_get(row, "otherwise"))
                parts = parts if last is None else (*parts, last)
                if role == "rules" or last is not None:
                    return Selector(parts)
                if memory or role == "remembered":
                    return Sequence(parts, memory=True)
                return (Block if any(isinstance(part, Branch) for part in parts) else Sequence)(parts)
        if condition is not None:
            test = negate(self.condition(condition)) if "unless" in row else self.condition(condition)
            test = negate(test) if _is_true(_get(row, "negate")) else test
            body = self.node(children if then is None else then)
            otherwise = self.node(_get(row, "otherwise"))
            if body is None and otherwise is None:
                return Check(test)
            if "while" in row or kind == "loop":
                return Loop(test, body or Sequence())
            return Branch(test, self.until(body or Sequence(), row), otherwise)
        if any(_get(row, role) is not None for role in ("all", "any", "not")):
            return Check(self.condition(row))
        if then is not None or children is not None:
            body = self.node(children if then is None else then)
            return None if body is None else self.until(body, row)
        values = [each for each in row.values() if isinstance(each, dict | list)]
        if len(values) == 1:  # a name, with the program
            return self.node(values[0])
        if any(isinstance(each, str) for key, each in row.items() if key not in _KEYS["comment"] + _KEYS["name"]):
            self.reading.note(
                self.line(next(each for each in row.values() if isinstance(each, str))),
                f"{shown(json.dumps(row))} is left out: it has no action and no condition",
            )
        return None

    def children(self, value: Any) -> list[Node]:
        values = value if isinstance(value, list) else [value]
        return [node for each in values if (node := self.node(each)) is not None]

    def until(self, node: Node, row: Mapping[str, Any]) -> Node:
        """Run a program until the condition of the key "until", if there is one."""
        until = _get(row, "until")
        return node if until is None else Loop(negate(self.condition(until)), node)

    def action(self, row: dict[str, Any]) -> Node:
        """Join the texts of an action, such as {"verb": "lower", "object": "the puck", "to": "the table"}."""
        key = next((each for each in (*_KEYS["action"], *_KEYS["text"]) if isinstance(row.get(each), str)), "")
        words = [row.pop(key, "")]
        line = self.line(words[0])
        for name, value in row.items():
            if isinstance(value, str) and not any(name in _KEYS[role] for role in ("comment", "type", "name", "until")):
                words.append(f"{name} {value}" if name in PROGRAM_WORDS["prepositions"] else value)
        return in_turn(" ".join(words), line)

    def condition(self, value: Any) -> Expression:
        """Convert a value to a condition."""
        self.count += 1
        if isinstance(value, list):
            return all_of(map(self.condition, value))
        if isinstance(value, bool):
            return TRUE if value else FALSE
        if not isinstance(value, dict):
            return as_expression(" ".join(str(value).split()))
        row = _normal(value)
        joins = _TYPES.get(" ".join(words_of(str(_get(row, "type", "")))))
        parts = list[Expression]()
        for role, join in (("all", all_of), ("any", any_of), ("not", any_of)):
            if (operands := _get(row, role)) is not None:
                part = join(map(self.condition, operands if isinstance(operands, list) else [operands]))
                parts.append(negate(part) if role == "not" else part)
        inner = next(
            (row[key] for key in (*_KEYS["condition"], *_KEYS["children"], "args", "operands") if key in row), None
        )
        if not parts and inner is not None:
            listed = inner if isinstance(inner, list) else [inner]
            parts = [(any_of if joins == "selector" else all_of)(map(self.condition, listed))]
            parts = [negate(parts[0])] if joins == "not" else parts
        if not parts:
            skipped = (*_KEYS["comment"], *_KEYS["type"], *_KEYS["negate"])
            texts = [each for key, each in row.items() if isinstance(each, str) and key not in skipped]
            parts = [as_expression(" ".join(" ".join(texts).split()))]
        result = all_of(parts)
        return negate(result) if _is_true(_get(row, "negate")) else result

    def machine(self, states: Any, row: Mapping[str, Any]) -> Node | None:
        """Convert a state machine to a selector: a later state is active once a condition that leads to it is true, and
        while no condition that leads back is. A plan has no memory, so the state that was active before is unknown.
        """
        rows = (
            [{"name": name, **_normal(each)} for name, each in states.items() if isinstance(each, dict)]
            if isinstance(states, dict)
            else [_normal(each) for each in states if isinstance(each, dict)]
        )
        named = {str(_get(each, "name")): each for each in rows}
        nodes = {name: self.state(each) for name, each in named.items()}
        exits = {name: self.exits(each, nodes[name]) for name, each in named.items()}
        order = [str(_get(row, "start", next(iter(named), "")))]
        for name in order:  # grows
            order += [target for _, target in exits.get(name, ()) if target in named and target not in order]
        order += [name for name in named if name not in order]
        parts = list[Node]()
        for place, name in reversed([*enumerate(order)]):
            if (node := nodes.get(name)) is None:
                continue
            enters = [test for source in order[:place] for test, target in exits.get(source, ()) if target == name]
            back = [test for test, target in exits[name] if target in order[:place]]
            guard = all_of([any_of(enters), negate(any_of(back))]) if place else TRUE
            parts.append(node if guard == TRUE else Branch(guard, node))
        return Selector(tuple(parts)) if parts else None

    def state(self, row: Mapping[str, Any]) -> Node | None:
        return self.node(_get(row, "action"))

    def exits(self, row: Mapping[str, Any], node: Node | None) -> list[tuple[Expression, str]]:
        """Return the (condition, name of the next state) pairs of a state."""
        done = all_of(Done(each.text) for each in actions_of(node))
        listed = _get(row, "transitions")
        if isinstance(listed, str):
            until = _get(row, "until")
            return [(done if until is None else self.condition(until), listed)]
        if isinstance(listed, dict):
            normal = _normal(listed)
            if _get(normal, "condition") is None:
                return [(self.condition(test), str(name)) for name, test in listed.items()]
            listed = [listed]
        pairs = list[tuple[Expression, str]]()
        for each in listed if isinstance(listed, list) else []:
            exit_row = _normal(each) if isinstance(each, dict) else {"to": each}
            test = _get(exit_row, "condition")
            pairs.append((done if test is None else self.condition(test), str(_get(exit_row, "target"))))
        return pairs


def _normal(value: Any) -> dict[str, Any]:
    """Return an object with its keys as lower-case words."""
    return {" ".join(words_of(str(key))): each for key, each in value.items()} if isinstance(value, dict) else {}


def _get(row: Mapping[str, Any], role: str, default: Any = None) -> Any:
    """Return the value of the first key that plays a role, such as "condition"."""
    return next((row[key] for key in _KEYS[role] if key in row and row[key] not in ("", None)), default)


def _is_true(value: Any) -> bool:
    return str(value).lower() in ("true", "yes")
