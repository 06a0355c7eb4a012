"""A parser of programs in JSON and YAML, which goes by structure and content; the keys are only hints.

A text that states something about the scene is a condition, and a text that begins with a verb is an action. An object
with conditions and actions is a branch, and a list with branches is a choice.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from dataclasses import replace
from typing import Any

from lw_torchrl._util.checks import shown
from lw_torchrl.language.connectives import parse_words
from lw_torchrl.language.expressions import FALSE, TRUE, Expression, all_of, any_of, as_expression, negate
from lw_torchrl.language.formats.base import (
    PROGRAM_WORDS,
    Reading,
    Section,
    code_blocks,
    command,
    in_turn,
    statement,
    words_of,
)
from lw_torchrl.language.formats.phrases import (
    ROLES,
    STRUCTURE,
    comparison_of,
    is_aside,
    is_bare,
    is_command,
    is_comparator,
    is_noun,
    is_predicate,
    is_statement,
    is_told,
    join_phrase,
    plain,
    role_of,
    truth_of,
)
from lw_torchrl.language.formats.sentences import SentenceReading
from lw_torchrl.language.formats.shapes import (
    MOST_VALUES,
    RULE,
    has_action,
    is_always,
    is_answer,
    is_facts,
    is_goal,
    is_program,
    is_reserved,
    is_skipped,
    is_test,
    names_of,
    states,
    texts_in,
    usual_shape,
    values_in,
)
from lw_torchrl.language.formats.state_machines import is_machine, machine, transitions_of
from lw_torchrl.language.formats.values import parse_value
from lw_torchrl.language.polarity import command_form, forbids, instruction
from lw_torchrl.language.programs import (
    Action,
    Block,
    Branch,
    Check,
    Loop,
    Node,
    Selector,
    Sequence,
    actions_of,
    is_condition,
)
from lw_torchrl.language.queries import split_words

_TYPES = {word: kind for kind, words in PROGRAM_WORDS["types"].items() for word in words}
_JOINS = ("selector", "sequence", "not", "memory")
_KINDS = (*_JOINS, "loop")
_LABELS = ("name", "comment", "start", "type")
_PROSE = re.compile(r"[.;?] +\w|, *(?:if|unless|otherwise)\b", re.IGNORECASE)
_SENTENCE = re.compile(r"(?:if|when|unless|otherwise|while)\b.*[,:]", re.IGNORECASE)
_LEAD = re.compile(r"\s*(?:if|when|whenever|while|once)\s+(?=\w+ )", re.IGNORECASE)
_CONDITIONAL = re.compile(r"\b(?:if|when|unless|otherwise|while)\b", re.IGNORECASE)
_PROHIBITION = re.compile(
    r"(?:the robot |you |it )?(?:(?:must|should|may|can|do) not|(?:must|should|do)n't|cannot|can't|never|avoid)\b",
    re.IGNORECASE,
)
_AND_OR = re.compile(r"\s*(?:\band\b|\bor\b|\bnot\b|[()&|!]+)\s*", re.IGNORECASE)


class TreeReading(Reading):
    """A reader of JSON and YAML. Each fenced block, or the text from the first bracket, is a section with a tree."""

    def __init__(self, text: str) -> None:
        super().__init__()
        for start, block in _sections(text):
            try:
                value = usual_shape(parse_value(block) if isinstance(block, str) else [*map(parse_value, block)])
                block = text if isinstance(block, list) else block
                value = self.without_asides(value, start, block)
                texts = [text for key, text in texts_in(value) if role_of(key) not in ("name", "comment")]
                is_prose = any(map(_PROSE.search, texts)) or all(map(_CONDITIONAL.search, texts))
                if value is None or ("{" not in block and is_prose):
                    continue  # sentences with colons look like YAML
                tree = Tree(self, block, start, value)
                node = tree.node(value)
                if unused := [names for names in tree.tables if names.isdisjoint(tree.used)]:  # not definitions
                    tree = Tree(self, block, start, value, set[str]().union(*unused))
                    node = tree.node(value)
            except ImportError:
                self.note(start + 1, "this may be YAML, which needs PyYAML to be read; run: pip install pyyaml")
                continue
            except (RecursionError, ValueError):
                self.error = "the tree is too large or nests too deeply"
                continue
            texts = [action.text for action in actions_of(node)]
            tree.note_lost(value, texts)
            is_program = "{" in str(value) or _has_condition(node) or all(map(is_told, texts))  # not a list in prose
            if node is not None and texts and is_program:
                self.sections.append(Section("", start + 1, tree=node))

    def without_asides(self, value: Any, start: int, text: str) -> Any:
        """Remove thoughts, examples and comments, unless no action remains; note each that may be a rule."""
        removed = list[tuple[str, Any]]()

        def rest(value: Any) -> Any:
            if isinstance(value, list):
                return [*map(rest, value)]
            if not isinstance(value, dict):
                return value
            asides = [key for key, each in value.items() if is_aside(str(key)) and truth_of(each) is None]
            removed.extend((str(key), value[key]) for key in asides)
            return {key: rest(each) for key, each in value.items() if key not in asides}

        kept = rest(value)
        if not removed or not has_action(kept):
            return value
        for key, each in removed:
            if has_action([each]) or any(_SENTENCE.match(text) for _, text in texts_in([each])):
                line = start + 1 + text.count("\n", 0, max(0, text.find(key)))
                self.note(line, f"{shown(each)} is left out: {shown(key)} is not a part of the plan")
        return kept


class Tree:
    """A converter from a JSON value to a program. A condition becomes a program that contains only checks."""

    def __init__(self, reading: Reading, text: str, start: int, value: Any, unused: Collection[str] = ()) -> None:
        self.reading, self.text, self.start, self.at, self.count = reading, text, start, 0, 0
        self.definitions, self.hidden, self.has_edges = dict[str, Any](), set[tuple[int, Any]](), False
        self.subgoals = set[int]()
        self.opened, self.conditions = list[str](), set[str]()  # definitions being read, texts read as conditions
        self.used, self.tables = set[str](), list[set[str]]()
        self.define(value, unused)

    def define(self, value: Any, unused: Collection[str]) -> None:
        """Find the programs and conditions that a text defines by name; they are parsed where their names are used."""
        tables = [each for _, each in values_in(value) if isinstance(each, dict | list)]
        self.has_edges = any(map(transitions_of, tables))
        counts, fields = _counts(value), Counter(texts_in(value))
        for table in tables:
            rows = [row for row in table if isinstance(row, dict)]
            if len(rows) > 1 and all(any(map(is_goal, row)) for row in rows):
                self.subgoals |= {id(row) for row in rows if not any(is_test(*pair) for pair in row.items())}
            keys = [*table] if isinstance(table, dict) else [*range(len(table))]
            names = [*map(str, keys)] if isinstance(table, dict) else names_of(table, counts, fields)
            if self.has_edges and len({*names}) > 1 and is_machine([table[key] for key in keys], {*names}):
                continue
            found = {
                name: key
                for name, key in zip(names, keys, strict=True)
                if name not in unused and not is_reserved(name, table[key])
                if counts[name] > _counts([table[key]])[name]
            }
            inside = _counts(table) if len(found) > 1 else counts
            is_table = any(counts[name] > inside[name] for name in found)  # named outside the table
            self.hidden |= {(id(table), key) for key in (keys if is_table else found.values())}
            self.definitions |= {name: table[key] for name, key in found.items()}
            self.tables += [{*found}] if found and has_action([table[key] for key in found.values()]) else []

    def note_lost(self, value: Any, actions: Collection[str]) -> None:
        """Note each text that begins with a verb but was not parsed as part of any action or condition."""
        kept = [{*plain(action).split()} for action in actions]
        rows = [each for _, each in values_in(value) if isinstance(each, dict) and "verb" in map(str, each)]
        phrases = [join_phrase(each, "act", self.definitions) for each in rows]
        verbs = [("", phrase.text) for phrase in phrases if phrase and phrase.verb]  # {"verb": "lift", "object": "mug"}
        for key, text in [*texts_in(value), *verbs]:
            words = command(text.replace('"', ""))
            is_state = text in self.conditions and is_predicate(re.split(r"[\s(]", text)[0])  # "open(gripper)"
            if is_state or role_of(key) in ("name", "comment") or " " not in words or not is_command(text):
                continue
            parts = [{*plain(part.text).split()} for part in actions_of(in_turn(words, 1))]
            if not all(any(part <= action for action in kept) for part in parts):
                self.reading.note(self.line(text), f"{shown(text)} is left out: no step has it")

    def line(self, text: str) -> int:
        """Return the line of the next occurrence of a text."""
        written = json.dumps(text, ensure_ascii=False)[1:-1]
        found = self.text.find(written, self.at)
        found = self.text.find(written) if found < 0 else found
        self.at = max(self.at, found)
        return self.start + 1 + self.text.count("\n", 0, self.at)

    def node(self, value: Any, hint: str = "") -> Node | None:
        """Convert a value to a program; None if it has neither actions nor conditions.

        ``hint`` is the kind of its texts: "test" for conditions, "act" for actions, "" to infer it from the content.
        """
        self.count += 1
        if self.count > MOST_VALUES:
            raise ValueError("too many values")
        if isinstance(value, bool):
            return Check(TRUE if value else FALSE) if hint == "test" else None
        if isinstance(value, list | dict):
            return self.listed(value, hint) if isinstance(value, list) else self.object(value, hint)
        is_text = isinstance(value, str) or str(value) in self.definitions
        return self.leaf(str(value).strip(" \n${}"), hint) if is_text else None

    def condition(self, value: Any) -> Expression:
        """Convert a value to a condition; an empty value becomes a condition that is always true."""
        return TRUE if value in ([], {}, "") else _condition(self.node(value, "test"))

    def leaf(self, text: str, hint: str) -> Node | None:
        """Convert a text to an action, a condition, or the program that it names."""
        if self.is_defined(text):
            self.opened.append(text)
            self.used.add(text)
            node = self.node(self.definitions[text], hint)
            self.opened.pop()
            return node
        if (is_always(text) and hint != "act") or (hint == "test" and truth_of(text) is not None):
            return Check(FALSE if truth_of(text) is False else TRUE)
        if hint != "test" and text[:1] == "!" and "(" not in text and is_command(text[1:]):  # marks an action
            return self.leaf(text[1:].strip(), "act")
        if rule := RULE.fullmatch(text):
            return self.object({"if": rule[1] or rule[4], "then": rule[2] or rule[5], "else": rule[3] or ""}, "")
        if (otherwise := re.match(r"(?:else|otherwise)[,:]? +(?!if\b)", text, re.IGNORECASE)) and hint != "test":
            return self.leaf(text[otherwise.end() :], "act")
        if hint != "act" and _SENTENCE.match(text) and any(actions_of(tree := SentenceReading(text).section.tree)):
            return tree
        if hint == "test" or (is_statement(text) if hint == "" else text.endswith("?")):
            return Check(self.said(text))
        if call := re.fullmatch(r"(?:\w+\.)?([A-Za-z]\w*)\((.*)\)", text):
            arguments = [each.strip(" '\"").partition("=") for each in call[2].split(",") if each.strip()]
            by_name = {key.strip(): each.strip(" '\"") for key, sign, each in arguments if sign}
            unnamed = [each for each, sign, _ in arguments if not sign]
            value = {"call": call[1], "of": unnamed, **by_name} if by_name else [call[1], *unnamed]
            if (phrase := self.phrase(value, hint)) is not None:
                return phrase
            text = f"{call[1]}({call[2]})"
        words = command(text) if " " in text or "(" in text else " ".join(words_of(text))
        words = words.lower() if words.split(" ")[0].isupper() else words
        return in_turn(words, self.line(text)) if words and (hint == "act" or is_told(text)) else None

    def said(self, text: str) -> Expression:
        """Convert a condition to an expression, and replace each defined name with its definition."""
        text = _LEAD.sub("", text)
        self.conditions.add(text)
        if self.is_defined(text):
            return _condition(self.leaf(text, "test"))
        words = split_words(statement(text))
        if is_always(text):
            return TRUE
        if not {*words} & self.definitions.keys() - {*self.opened}:
            return as_expression(statement(text))

        def operand(words: list[str]) -> Expression:
            if words[0].lower() == "not" and len(words) == 2:
                return negate(operand(words[1:]))
            return self.said(" ".join(words)) if words[0] in self.definitions else as_expression(" ".join(words))

        return parse_words(words, operand, lambda number, expected: ValueError(expected)) or TRUE

    def phrase(self, value: Any, hint: str) -> Node | None:
        """Convert a value with names of objects, relations and verbs, such as {"near": ["gripper", "mug"]}."""
        parts = list[dict[Any, Any]]()
        if isinstance(value, dict) and hint != "act":
            for key, inner in value.items():  # {"gripper": {"near": "mug", "is": "open"}, "above": ["mug", "table"]}
                is_table = isinstance(inner, dict) and is_noun(str(key))
                is_fact = is_predicate(str(key)) and isinstance(inner, list)
                is_fact |= is_noun(str(key)) and isinstance(inner, str) and is_predicate(inner)
                parts += [{key: {name: each}} for name, each in inner.items()] if is_table else [{key: inner}] * is_fact
            if len(parts) > 1 and len(parts) >= len(value):
                nodes = [self.phrase(part, hint) for part in parts]
                return _joined([node for node in nodes if node is not None], "")
        if (phrase := join_phrase(value, hint, self.definitions)) is None:
            return None
        if phrase.verb:
            return in_turn(phrase.text, self.line(phrase.verb))
        return Check(negate(as_expression(phrase.text)) if phrase.is_negated else as_expression(phrase.text))

    def listed(self, value: list[Any], hint: str, kind: str = "") -> Node | None:
        """Convert a list: conditions are joined, branches are alternatives, and other programs run in turn."""
        first = value[0] if len(value) > 1 and isinstance(value[0], str) and not kind and not is_told(value[0]) else ""
        role = (_TYPES.get(plain(first)) or role_of(first)) if first and first not in self.definitions else ""
        if role == "test" and len(value) > 2:  # ["if", condition, program, program]
            return self.object(dict(zip(("if", "then", "else"), value[1:], strict=False)), "")
        if role in _JOINS:
            return self.object({first: value[1:]}, hint)
        if role in ("test", "condition", "act", "action", "else"):
            inner = value[1] if len(value) == 2 else value[1:]
            return self.node(inner, "test" if role in ("test", "condition") else "act")
        if first and (phrase := self.phrase(value, hint)) is not None:
            return phrase
        nodes = list[Node]()
        for number, each in enumerate(value):
            is_text = self.is_unknown(each)
            is_test = is_text and kind == "sequence" and number + 1 < len(value)
            inner = "test" if is_test or hint == "test" else "act" if is_text and (kind or hint == "act") else ""
            if (id(value), number) not in self.hidden and (node := self.node(each, inner)) is not None:
                nodes.append(node)
        return _joined(nodes, kind)

    def object(self, row: dict[Any, Any], hint: str) -> Node | None:
        """Convert a mapping. This method parses its type and flags, and :meth:`branch` parses its other fields."""
        flags = {plain(str(key)): truth_of(value) for key, value in row.items()}
        is_off = any(flag and (key in ("disabled", "skip") or is_aside(key)) for key, flag in flags.items())
        if is_off or flags.get("enabled") is False:
            self.reading.note(self.line(str(next(iter(row)))), "a disabled part is left out")
            return None
        if self.has_edges and (selector := machine(self, row)) is not None:
            return selector
        if hint != "act" and (comparison := comparison_of(row)):
            return Check(negate(self.said(comparison[0])) if comparison[1] else self.said(comparison[0]))
        kind, memory, negated, fields = "", False, False, dict[str, Any]()
        is_flat = not any(isinstance(each, dict | list) for each in row.values())
        is_decorator = plain(str(row.get("type"))) == "decorator"  # {"type": "decorator", "name": "not"}
        for place, (name, value) in enumerate(row.items()):
            key, role, truth = str(name), role_of(str(name)), truth_of(value)
            text = plain(value.split(".")[-1]) if isinstance(value, str) else ""
            texts = value if isinstance(value, list) else [value]
            is_rule = role == "else" or _CONDITIONAL.match(key) is not None or is_statement(key)
            if plain(key).startswith("never "):
                self.reading.note(self.line(key), f"{shown(row)} is left out: {shown(key)} forbids it")
                return None  # {"never_if": ..., "do": ...}
            if role != "act" and not is_rule and _forbids_only(key, texts):
                self.reading.note(self.line(key), f"{shown(value)} is left out: it forbids an action")
                continue  # {"constraints": ["do not lift the mug"]}
            is_forbidden = all(isinstance(each, str) and _is_act(each) for each in texts)
            is_forbidden |= forbids(plain(key)) and any(map(has_action, texts))  # {"do_not": [{"when": ...}]}
            if is_forbidden and not is_rule and not instruction(plain(key)).text:
                self.reading.note(self.line(key), f"{shown(value)} is left out: {shown(key)} forbids it")
                continue  # {"never": "close the gripper"}
            if place and plain(key) in ("elif", "else if", "elseif"):
                rest = dict([*row.items()][place + 1 :])
                is_chain = isinstance(value, list) and any(map(has_action, value))
                fields["else"] = [*value, *rest.values()] if is_chain else {"if": value, **rest}
                break
            if role in ("not", "truth") and truth is not None:
                negated ^= truth == (role == "not")
            elif (id(row), name) in self.hidden or is_skipped(row, key, value):
                continue
            elif id(row) in self.subgoals and is_goal(name) and states(value):
                fields["until"] = value
            elif role == "memory" and not isinstance(value, dict | list):
                memory = bool(truth)
            elif role == "type" and is_comparator(value) and is_flat:
                fields[key] = value  # {"op": ">", "value": 0.05, ...}
            elif ROLES.get(text) in _KINDS and role not in ("comment", "act") and (role != "name" or is_decorator):
                kind = kind or ROLES[text]
            elif role == "type" and isinstance(value, str) and re.search(r"\w[ (]", value) and is_command(value):
                fields["do"] = value  # {"control": "move_to(gripper, mug)"}
            elif role == "type" and text in PROGRAM_WORDS["always"]:
                return Check(TRUE)
            elif role == "type" and text and not is_told(value) and (text in _TYPES or not is_bare(text)):
                kind = kind or _TYPES.get(text) or _TYPES.get(text.split()[-1], "")
                if is_predicate(text) or is_comparator(value):
                    fields[key] = value  # {"op": "near", ...}
            elif isinstance(value, dict) and role in ("", "selector") and is_answer(value) and not is_statement(key):
                fields |= {str(inner): each for inner, each in value.items()}  # {"switch": ..., "cases": {"true": ...}}
            else:
                fields[key] = value
        if kind in ("action", "condition"):
            hint, kind = "act" if kind == "action" else hint if has_action(row) else "test", ""
        node = self.branch(fields, hint, kind)
        if node is None:
            labels = {key: each for key, each in fields.items() if isinstance(each, str) and role_of(key) in _LABELS}
            texts = [each for each in labels.values() if is_told(each) or self.is_defined(each)]
            texts += [each for key, each in labels.items() if hint and role_of(key) == "name"]
            node = self.node(texts[0], hint) if texts else None
        if isinstance(node, Sequence) and (memory or kind == "memory"):
            node = Sequence(node.parts, memory=True)
        if negated and isinstance(node, Branch | Loop):
            return replace(node, condition=negate(node.condition))
        if node is not None and negated != (kind == "not") and is_condition(node):
            return Check(negate(_condition(node)))
        return node

    def branch(self, fields: dict[str, Any], hint: str, kind: str) -> Node | None:
        """Convert a JSON object to a program in which the object's conditions guard its actions."""
        tests, bodies, otherwise, until = list[Expression](), list[Node](), list[Node](), None
        row = fields
        join = kind if kind in _JOINS else ""
        labels = [value for key, value in fields.items() if role_of(key) == "name" and isinstance(value, str)]
        if any(map(is_told, labels)):  # {"shape": "box", "label": "close the gripper"}
            fields = {key: value for key, value in fields.items() if role_of(key) or not self.is_unknown(value)}
        free = {key: value for key, value in fields.items() if role_of(key) not in STRUCTURE[:5]}
        has_act = any(role_of(key) == "act" for key in free)
        if has_act:
            free = {key: value for key, value in free.items() if role_of(key) or not value or not is_facts(value)}
        is_whole = hint != "test" or len(free) == len(fields)
        if not join and is_whole and (node := self.phrase(free, hint or ("act" if has_act else ""))) is not None:
            fields = {key: value for key, value in fields.items() if key not in free}
            if is_condition(node):
                tests.append(_condition(node))
            else:
                bodies.append(node)
        fields = {key: value for key, value in fields.items() if role_of(key) not in _LABELS or is_program(key, value)}
        if any(isinstance(value, dict | list) and has_action(value) for value in fields.values()):
            has_test = any(role_of(key) in STRUCTURE[:4] for key in fields)
            texts = {key: value for key, value in fields.items() if role_of(key) == "" and isinstance(value, str)}
            titles = {key for key, value in texts.items() if is_command(value) or (has_test and " " not in value)}
            fields = {key: value for key, value in fields.items() if key not in titles}
        ways = [key for key, value in fields.items() if role_of(key) == "" and has_action(value)]
        if len(fields) == 3 and len(ways) == 2 and not join and not tests:  # {"split": ..., "left": ..., "right": ...}
            test = next(value for key, value in fields.items() if key not in ways)
            if states(test) and not has_action(test):
                fields = {"if": test, "then": fields[ways[0]], "else": fields[ways[1]]}
        if join and [role_of(key) for key in fields] == ["test"]:  # {"type": "or", "conditions": [...]}
            value = next(iter(fields.values()))
            return self.listed(value if isinstance(value, list) else [value], "test", join)
        inner = hint if hint == "test" or len(fields) == 1 else ""
        for key, value in fields.items():
            role = role_of(key)
            if role == "unless" or (role in ("test", "loop") and not has_action(value)):
                test = self.condition(value)
                tests.append(negate(test) if role == "unless" else test)
            elif role == "until" and (isinstance(value, str) or not has_action(value)):
                until = self.condition(value)
                until = None if until in (TRUE, FALSE) else until
            elif role == "else" or (plain(key) == "fallback" and isinstance(value, str)):
                node = self.node(value, "act")
                otherwise += [] if node is None else [node]
            elif (node := self.field(key, value, role, inner, join)) is not None:
                if join or not is_condition(node):
                    bodies.append(node)
                else:
                    tests.append(_condition(node))
        if tests and hint != "test" and not (bodies or otherwise):  # {"when": ..., "goal": ...}
            goals = [each for key, each in row.items() if is_goal(key) and isinstance(each, str) and states(each)]
            bodies += [Action("", self.line(goal), goal) for goal in goals[:1]]
        if join and not bodies:
            bodies, tests = [Check(test) for test in tests], []
        body = _joined(bodies, join or ("" if any(map(_is_guarded, bodies)) else "sequence"))
        if until is not None and tests:
            tests.append(negate(until))
        elif until is not None and body is not None:
            body = Loop(negate(until), body)
        last = _joined(otherwise, "selector")
        if not tests:
            return last if body is None else body if last is None else Selector((body, last))
        if body is None and last is None:
            return Check(all_of(tests))
        is_loop = kind == "loop" or any(role_of(key) == "loop" for key in fields)
        return Loop(all_of(tests), body or Sequence()) if is_loop else Branch(all_of(tests), body or Sequence(), last)

    def is_defined(self, text: str) -> bool:
        return text in self.definitions and text not in self.opened

    def is_unknown(self, value: Any) -> bool:
        """Return whether a value is a string that says nothing about the plan."""
        return isinstance(value, str) and not is_told(value) and value not in self.definitions

    def field(self, key: str, value: Any, role: str, hint: str, join: str) -> Node | None:
        """Convert a field to a program node according to its key."""
        if plain(key) == "nand":
            return self.object({"not": {"all": value}}, hint)
        if role in ("", "test", "loop") and is_statement(key):
            if (truth := truth_of(value)) is not None:
                return Check(self.said(key) if truth else negate(self.said(key)))
            if str(value).lower() in ("*", "-", "any", ""):  # any value, in a decision table
                return None
            return self.object({"if": key, **(value if isinstance(value, dict) else {"then": value})}, "")
        is_deed = role == "" and is_command(key) and (value is None or isinstance(value, dict | list))
        if is_deed and not has_action(value):  # {"grasp": {"preconditions": [...]}}
            action = self.leaf(key, "act") or Sequence()
            return Branch(self.condition(value), action) if value else action
        if role in _JOINS:
            if self.is_unknown(value):
                return None  # {"select": "first_valid"}
            is_children = isinstance(value, dict) and role != "not"
            children = value if is_children else {"children": value if isinstance(value, list) else [value]}
            return self.object({"type": role, **children}, hint)
        if role == "" and is_facts({key: value}):
            return self.phrase({key: value}, "test")
        if join and isinstance(value, list) and role != "act":
            return self.listed(value, hint, join)
        return self.node(value, "act" if role == "act" else hint)


def _forbids_only(key: str, values: list[Any]) -> bool:
    """Return whether a field has only prohibitions, or only texts below a key such as "avoid"."""
    if re.fullmatch(r"(?:(?:actions|things|what) to )?avoid", plain(key)):
        return all(isinstance(each, str) for each in values)
    return bool(values) and all(isinstance(each, str) and _PROHIBITION.match(each) for each in values)


def _is_act(text: str) -> bool:
    """Return whether a text is a command, or names an action: "lifting the puck"."""
    return is_command(text) or command_form(text.lower().partition(" ")[0]) is not None


def _sections(text: str) -> list[tuple[int, str | list[str]]]:
    """Return a (line, text) pair for each code block, or one pair with all blocks if a block names keys of another."""
    blocks = [*code_blocks(text)]
    found = list[Any]()
    with suppress(ImportError, ValueError, RecursionError):
        found = [parse_value(block) for _, block in blocks] if len(blocks) > 1 else []
    names = [{str(key) for key in value} if isinstance(value, dict) else set[str]() for value in found]
    for number, value in enumerate(found):
        said = {text for _, text in texts_in(value)}
        if any(len(said & each) > 1 for other, each in enumerate(names) if other != number):
            return [(0, [block for (_, block), value in zip(blocks, found, strict=True) if value is not None])]
    return [*blocks]


def _counts(value: Any) -> Counter[str]:
    """Count possible references to definitions in a value: each text, and its parts joined by "and" or "or"."""
    texts = [text for key, text in texts_in(value) if role_of(key) not in ("name", "comment")]
    return Counter(name for text in texts for name in {text, *_AND_OR.split(text)})


def _condition(node: Node | None) -> Expression:
    """Convert a program that consists only of checks to a single condition."""
    if isinstance(node, Sequence | Selector):
        return (all_of if isinstance(node, Sequence) else any_of)(map(_condition, node.parts))
    return node.condition if isinstance(node, Check) else TRUE


def _has_condition(node: Node | None) -> bool:
    return isinstance(node, Branch | Check) or any(map(_has_condition, getattr(node, "parts", ())))


def _is_guarded(node: Node) -> bool:
    if isinstance(node, Branch):
        return node.condition != TRUE
    return isinstance(node, Sequence) and bool(node.parts) and is_condition(node.parts[0])


def _joined(nodes: list[Node], kind: str) -> Node | None:
    """Join programs by the given kind, or by a kind inferred from their types."""
    if not nodes:
        return None
    if all(map(is_condition, nodes)):
        return Check((any_of if kind in ("selector", "not") else all_of)(map(_condition, nodes)))
    if len(nodes) == 1:
        return nodes[0]
    if kind in ("sequence", "memory"):
        if isinstance(last := nodes[-1], Branch) and last.condition == TRUE:
            return Selector(tuple(nodes))
        has_branch = kind == "sequence" and any(isinstance(each, Branch) for each in nodes)
        return (Block if has_branch else Sequence)(tuple(nodes))
    if kind:
        return Selector(tuple(nodes))
    if checks := next(number for number, node in enumerate(nodes) if not is_condition(node)):
        rest = _joined(nodes[checks:], "")
        return Sequence((*nodes[:checks], *([rest] if rest else [])))
    guarded = [number for number, node in enumerate(nodes) if _is_guarded(node)]
    if not guarded:
        return Sequence(tuple(nodes))
    waits = any(isinstance(node, Loop) for node in nodes)
    waits |= any(isinstance(node, Action) for node in nodes[: guarded[-1]])
    return (Block if waits else Selector)(tuple(nodes))
