"""A reader of programs in JSON and YAML: behaviour trees, rules, state machines and nested choices, with any keys."""

from __future__ import annotations

import ast
import json
import re
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from typing import Any

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import FALSE, TRUE, Expression, all_of, any_of, as_expression, negate
from lw_torchrl.language.formats.base import (
    PROGRAM_WORDS,
    Reading,
    code_blocks,
    command,
    in_turn,
    is_verb,
    statement,
    words_of,
)
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
_KNOWN = {word for words in _KEYS.values() for word in words}
_TYPES = {word: kind for kind, words in PROGRAM_WORDS["types"].items() for word in words}
_MOST_VALUES = 20_000  # YAML's references can repeat a value
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|//[^\n]*|/\*.*?\*/|#[^\n]*|[^"\[\]{},/#]+|.', re.DOTALL)
_YAML = re.compile(r"^\s*(?:- )?[\w -]{1,40}:(?:\s|$)", re.MULTILINE)
_NUMBERED = re.compile(r"[a-z]+ \d+")
_CODE = re.compile(r"^\s*(?:async )?(?:def|class) \w", re.MULTILINE)


class TreeReading(Reading):
    """A reader of JSON and YAML. Each fenced block, or the text from the first bracket, is a section with a tree."""

    def __init__(self, text: str) -> None:
        super().__init__()
        for start, block in code_blocks(text):
            value = self.parse(block, start)
            if not isinstance(value, dict | list):
                continue
            tree = _Tree(self, block, start, _definitions(value))
            try:
                node = tree.node(value)
            except (RecursionError, ValueError):
                self.error = "the tree is too large or nests too deeply"
                continue
            texts = [action.text.split() for action in actions_of(node)]
            tree.note_lost(value, [" ".join(words) for words in texts])
            # A list of texts in prose is not a plan.
            is_listing = "{" not in str(value) and not _has_branch(node)
            if (
                node is not None
                and texts
                and not (is_listing and any(len(words) < 2 or not is_verb(words) for words in texts))
            ):
                self.add_tree("", start + 1, node)

    def parse(self, block: str, start: int) -> Any:
        """Parse JSON or YAML; None if the text is neither."""
        bracket = re.search(r"[{\[]", block)
        before = block if bracket is None else block[: bracket.start()]
        is_yaml = len(_YAML.findall(before)) > 1 and not _CODE.search(block)
        value = None if is_yaml or bracket is None else _json(block[bracket.start() :])
        if value is not None or len(_YAML.findall(block)) < 2 or _CODE.search(block):
            return value
        try:
            return _yaml(block)
        except ImportError:
            self.note(start + 1, "this may be YAML, which needs PyYAML to be read; run: pip install pyyaml")
            return None


def _has_branch(node: Node | None) -> bool:
    return isinstance(node, Branch) or any(map(_has_branch, getattr(node, "parts", ())))


def _definitions(value: Any) -> dict[str, Any]:
    """Return the programs and conditions that a text defines by name, such as {"subtrees": {"grasp": ...}}."""
    found = dict[str, Any]()
    stack = [value]
    said = {text for _, text in _texts(value)}
    for each in stack:  # grows
        if isinstance(each, dict):
            is_machine = _get(_normal(each), "transitions") is not None
            for key, inner in each.items():
                role = " ".join(words_of(str(key)))
                is_table = isinstance(inner, dict) and inner and said.issuperset(inner)  # all its names are used
                is_table = is_table and not is_machine and role not in _KEYS["states"] + _KEYS["transitions"]
                if is_table or role in _KEYS["definitions"]:
                    rows = inner if isinstance(inner, list) else []
                    found |= (
                        inner
                        if isinstance(inner, dict)
                        else {str(row["id"]): row for row in rows if isinstance(row, dict) and "id" in row}
                    )
            stack += each.values()
        elif isinstance(each, list):
            stack += each
        if len(stack) > _MOST_VALUES:
            break
    return found


def _texts(value: Any) -> Iterator[tuple[str, str]]:
    """Yield each text in a value with its key."""
    stack = [("", value)]
    for key, each in stack:  # grows
        if isinstance(each, str):
            yield key, each.strip()
        elif isinstance(each, dict | list) and len(stack) < _MOST_VALUES:
            pairs = each.items() if isinstance(each, dict) else ((key, part) for part in each)
            stack += [(str(name), part) for name, part in pairs]


def _json(text: str) -> Any:
    """Parse JSON, with comments, trailing commas and missing brackets; None if the text is not JSON."""
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
    """Parse YAML without its types; None if the text is not YAML."""
    import yaml  # type: ignore[import-untyped]

    with suppress(yaml.YAMLError, ValueError, RecursionError):
        return yaml.load(text, getattr(yaml, "CBaseLoader", yaml.BaseLoader))
    return None


class _Tree:
    """The conversion of a JSON value to a program."""

    def __init__(self, reading: Reading, text: str, start: int, definitions: Mapping[str, Any]) -> None:
        self.reading, self.text, self.start, self.at, self.count = reading, text, start, 0, 0
        self.definitions, self.opened = definitions, list[str]()  # opened: the definitions that are being read
        self.conditions = set[str]()  # texts that were read as conditions

    def note_lost(self, value: Any, actions: Collection[str]) -> None:
        """Note each text that begins with a verb but is in no action or condition of the program."""
        for key, text in _texts(value):
            is_action = " ".join(words_of(key)) not in _KEYS["comment"] + _KEYS["name"] and len(text.split()) > 1
            if is_action and is_verb(command(text).split()) and text not in self.conditions:
                parts = [part.text for part in actions_of(in_turn(command(text), 1))]
                if not all(any(part in action for action in actions) for part in parts):
                    self.reading.note(self.line(text), f"{shown(text)} is left out: no step has it")

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
            return self.leaf(value.strip())
        if isinstance(value, list):
            if value and isinstance(value[0], str) and (kind := _TYPES.get(value[0].lower())):  # ["sequence", ...]
                rest = value[1] if kind in ("condition", "action") and len(value) == 2 else value[1:]
                return self.object({"type": kind, "text" if isinstance(rest, str) else "children": rest})
            pairs = [each for each in value if isinstance(each, list) and len(each) == 2]
            if pairs == value and all(isinstance(test, str) and is_verb(str(then).split()) for test, then in pairs):
                value = [{"if": test, "then": then} for test, then in pairs]
            nodes = self.children(value)
            rules = is_rule_list or any(isinstance(each, Branch) for each in nodes)
            return None if not nodes else Selector(tuple(nodes)) if rules else Sequence(tuple(nodes))
        return self.object(_normal(value)) if isinstance(value, dict) else None

    def leaf(self, text: str) -> Node | None:
        """Convert a text to an action, a condition that ends with "?", or the program that it names."""
        if text in self.definitions and text not in self.opened:
            self.opened.append(text)
            node = self.node(self.definitions[text])
            self.opened.pop()
            return node
        if text.endswith("?"):
            return Check(self.condition(text))
        words = command(text)
        return in_turn(words, self.line(text)) if words else None

    def object(self, row: dict[str, Any]) -> Node | None:
        row = {
            key: each
            for key, each in row.items()
            if not (key in _KEYS["otherwise"] and _is_true(each))  # {"else": true, "do": ...}
            and not (isinstance(each, dict) and key not in _KEYS["states"] and each.keys() <= self.definitions.keys())
        }
        kind = _TYPES.get(" ".join(words_of(str(_get(row, "type", "")))))
        memory = kind == "memory" or _is_true(_get(row, "memory"))
        kind = "sequence" if kind == "memory" else kind
        condition, then = self.tests(row), _get(row, "action")
        children = _get(row, "children")
        if isinstance(root := row.get("root"), str) and root in self.definitions:
            return self.leaf(root)
        if (reference := _get(row, "reference")) is not None and str(reference) in self.definitions:
            node = self.leaf(str(reference))
            return node if condition is None or node is None else Branch(condition, node)
        states, exits = _get(row, "states"), _get(row, "transitions")
        if states is None and isinstance(then, dict) and exits is not None:  # a table of actions, and one of exits
            by_state = exits if isinstance(exits, dict) else {}
            for each in exits if isinstance(exits, list) else []:
                by_state.setdefault(str(each.get("from")) if isinstance(each, dict) else "", []).append(each)
            states = {name: {"action": each, "transitions": by_state.get(name, [])} for name, each in then.items()}
        if states is not None:
            return self.object(_normal(states)) if "states" in _normal(states) else self.machine(states, row)
        if kind in ("selector", "sequence", "not") and children is not None:
            parts = tuple(self.children(children))
            if kind == "not" and all(map(is_condition, parts)):
                return Check(negate(all_of(part.condition for part in parts if isinstance(part, Check))))
            return Selector(parts) if kind == "selector" else Sequence(parts, memory)
        if kind == "condition":
            return Check(self.condition(row))
        if any(_NUMBERED.fullmatch(key) and key.split(" ")[0] in _TYPES for key in row):
            return Sequence(tuple(self.typed(row)))
        if kind == "action" or (kind is None and condition is None and isinstance(then, str)):
            return self.until(self.action(row), row)
        for role in ("rules", "sequence", "remembered"):
            if isinstance(rules := _get(row, role), list | dict):
                parts = tuple(self.children(rules))
                last = None if (other := _get(row, "otherwise")) is rules else self.node(other)
                parts = parts if last is None else (*parts, last)
                if role == "rules" or last is not None:
                    return Selector(parts)
                if memory or role == "remembered":
                    return Sequence(parts, memory=True)
                if (
                    parts and isinstance(parts[-1], Branch) and parts[-1].condition == TRUE
                ):  # the last rule is the default
                    return Selector(parts)
                return (Block if any(isinstance(part, Branch) for part in parts) else Sequence)(parts)
        if condition is not None:
            test = negate(condition) if _is_true(_get(row, "negate")) else condition
            body = self.node(children if then is None else then)
            otherwise = self.node(_get(row, "otherwise"))
            if (
                "if" in row and (then_elif := row.get("then elif")) is not None
            ):  # "elif" and "then_elif" of the same object
                otherwise = Branch(self.condition(row.get("elif")), self.node(then_elif) or Sequence(), otherwise)
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
        if (otherwise := _get(row, "otherwise")) is not None:
            return self.node(otherwise)
        if typed := self.typed(row):
            return typed[0] if len(typed) == 1 else Sequence(tuple(typed))
        values = [each for each in row.values() if isinstance(each, dict | list)]
        if len(values) == 1 or (values and all(key.isdigit() for key in row)):  # a name or numbers, with programs
            return self.node(values[0] if len(values) == 1 else values)
        if any(isinstance(each, str) for key, each in row.items() if key not in _KEYS["comment"] + _KEYS["name"]):
            self.reading.note(
                self.line(next(each for each in row.values() if isinstance(each, str))),
                f"{shown(json.dumps(row))} is left out: it has no action and no condition",
            )
        return None

    def tests(self, row: Mapping[str, Any]) -> Expression | None:
        """Return the condition of the keys "if", "unless" and the like; None without any."""
        tests = [] if (condition := _get(row, "condition")) is None else [self.condition(condition)]
        tests += [negate(self.condition(row["unless"]))] if "unless" in row else []
        if _get(row, "action") is not None:  # {"any": [...], "do": ...}
            joins = {role: row[role] for role in ("all", "any", "not") if isinstance(row.get(role), list | dict)}
            tests += [self.condition(joins)] if joins else []
        return all_of(tests) if tests else None

    def typed(self, row: Mapping[str, Any]) -> list[Node]:
        """Return the parts of an object whose keys begin with a type: {"condition 1": ..., "sequence push": ...}."""
        parts = list[Node]()
        kinds = [(key.split(" ")[0].rstrip("0123456789"), each) for key, each in row.items()]
        if sum(word in _TYPES for word, _ in kinds) < 2 and not any(map(_NUMBERED.fullmatch, row)):
            return []
        for word, each in kinds:
            kind = _TYPES.get(word)
            if kind == "condition":
                parts.append(Check(self.condition(each)))
            elif kind in ("selector", "sequence"):
                parts.append((Selector if kind == "selector" else Sequence)(tuple(self.children(each))))
            elif kind is not None and (node := self.node(each)) is not None:
                parts.append(node)
        return parts

    def children(self, value: Any) -> list[Node]:
        if isinstance(value, dict):
            row = _normal(value)
            nested = _get(row, "children")
            return self.typed(row) or self.children([value] if nested is None else nested)
        values = value if isinstance(value, list) else [value]
        nodes = list[Node]()
        for number, each in enumerate(values):
            # In a sequence of texts, those that do not begin with a verb are conditions.
            is_test = isinstance(each, str) and number + 1 < len(values) and each not in self.definitions
            if is_test and not is_verb(command(each).split()):
                nodes.append(Check(self.condition(each)))
            elif (node := self.node(each)) is not None:
                nodes.append(node)
        return nodes

    def until(self, node: Node, row: Mapping[str, Any]) -> Node:
        """Run a program until the condition of the key "until", if there is one."""
        until = _get(row, "until")
        return node if until is None else Loop(negate(self.condition(until)), node)

    def action(self, row: dict[str, Any]) -> Node:
        """Join the texts of an action, such as {"verb": "lower", "object": "the puck", "to": "the table"}."""
        key = next((each for each in (*_KEYS["action"], *_KEYS["text"]) if isinstance(row.get(each), str)), "")
        line = self.line(row.get(key, ""))
        words = [command(row.pop(key, ""))]
        explained = " ".join(words_of(str(row.get("description", "")))).split(" ")
        if (
            explained[0] == words[0].replace("_", " ").split(" ")[0]
        ):  # {"skill": "push", "description": "push the door"}
            return in_turn(str(row["description"]), line)
        if isinstance(arguments := row.pop("args", None), list):
            words += [str(each) for each in arguments]
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
            return self.said(str(value).strip())
        row = _normal(value)
        joins = " ".join(words_of(str(_get(row, "type", ""))))
        kind = _TYPES.get(joins)
        parts = list[Expression]()
        for role, join in (("all", all_of), ("any", any_of), ("not", any_of)):
            if (operands := _get(row, role)) is not None:
                part = join(map(self.condition, operands if isinstance(operands, list) else [operands]))
                parts.append(negate(part) if role == "not" else part)
        relation = next((key for key in _KEYS["relation"] if isinstance(row.get(key), str)), "")
        inner = next(
            (row[key] for key in (*_KEYS["condition"], *_KEYS["children"], *_KEYS["operands"]) if key in row), None
        )
        if relation:
            operands = row.get("args") or [_get(row, "subject", ""), _get(row, "object", "")]
            first, *others = [str(each) for each in operands] if isinstance(operands, list) else [str(operands)]
            part = self.said(" ".join([first, " ".join(words_of(row[relation])), *others]).strip())
            parts.append(negate(part) if relation.endswith("not") else part)
        elif not parts and inner is not None:
            join = any_of if kind == "selector" or joins in _KEYS["any"] or joins in _KEYS["not"] else all_of
            part = join(map(self.condition, inner if isinstance(inner, list) else [inner]))
            parts = [negate(part) if kind == "not" or joins in _KEYS["not"] else part]
        if not parts and joins not in PROGRAM_WORDS["always"]:
            skipped = (*_KEYS["comment"], *_KEYS["type"], *_KEYS["negate"])
            texts = [each for key, each in row.items() if isinstance(each, str) and key not in skipped]
            named = [each for key, each in row.items() if key in _KEYS["name"] and each in texts]
            texts = [each for each in texts if each not in named] or texts
            parts = [self.said(" ".join(texts))] if texts else []
        result = all_of(parts)
        return negate(result) if _is_true(_get(row, "negate")) else result

    def said(self, text: str) -> Expression:
        """Convert a text to a condition; a name that the text defines stands for its definition."""
        self.conditions.add(text)
        if text in self.definitions and text not in self.opened:
            self.opened.append(text)
            condition = self.condition(self.definitions[text])
            self.opened.pop()
            return condition
        return TRUE if text.lower() in PROGRAM_WORDS["always"] else as_expression(statement(text))

    def machine(self, states: Any, row: Mapping[str, Any]) -> Node | None:
        """Convert a state machine to a selector: a later state is active once a condition that leads to it is true, and
        while no condition that leads back is. A plan has no memory, so the state that was active before is unknown.
        """
        rows = (
            [{"name": name, **_normal(each)} for name, each in states.items() if isinstance(each, dict)]
            if isinstance(states, dict)
            else [_normal(each) for each in states if isinstance(each, dict)]
        )
        if not any(_get(each, role) is not None for each in rows for role in ("transitions", "until")):
            return Selector(tuple(node for each in rows if (node := self.object(each)) is not None))  # guarded states
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
            is_pair = isinstance(each, list) and len(each) == 2  # [condition, name]
            exit_row = (
                _normal(each)
                if isinstance(each, dict)
                else dict(zip(("if", "to"), each, strict=True))
                if is_pair
                else {"to": each}
            )
            test = _get(exit_row, "condition")
            pairs.append((done if test is None else self.condition(test), str(_get(exit_row, "target"))))
        return pairs


def _normal(value: Any) -> dict[str, Any]:
    """Return an object with its keys as lower-case words; an unknown key such as "entry action" is its last word."""
    row = {" ".join(words_of(str(key))): each for key, each in value.items()} if isinstance(value, dict) else {}
    unknown = {key for key in row if key not in _KNOWN and key not in PROGRAM_WORDS["always"]}
    short = {key: key.split(" ")[-1] for key in unknown if key.count(" ") == 1 and key.split(" ")[0] not in _TYPES}
    result = dict[str, Any]()
    for key, each in row.items():
        last = short.get(key, key)
        result[last if last in _KNOWN and last not in row.keys() | result.keys() else key] = each
    return result


def _get(row: Mapping[str, Any], role: str, default: Any = None) -> Any:
    """Return the value of the first key that plays a role, such as "condition"."""
    return next((row[key] for key in _KEYS[role] if key in row and row[key] not in ("", None)), default)


def _is_true(value: Any) -> bool:
    return str(value).lower() in ("true", "yes")
