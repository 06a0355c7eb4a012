"""A reader of programs in Python: any function with control flow. The text is parsed, never executed."""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import FALSE, TRUE, Expression, all_of, any_of, as_expression, negate
from lw_torchrl.language.formats.base import (
    PROGRAM_WORDS,
    Reading,
    code_blocks,
    is_for_any_task,
    is_verb,
    task_name,
    words_of,
)
from lw_torchrl.language.formats.python import state_to_reach
from lw_torchrl.language.programs import (
    Action,
    Block,
    Branch,
    Jump,
    Label,
    Loop,
    Node,
    ProgramError,
    actions_of,
    choose,
)

PYTHON = PROGRAM_WORDS["python"]
_RELATIONS = [*PROGRAM_WORDS["prepositions"], "of", "aligned"]  # the last words of relations
_COMMENTS = PROGRAM_WORDS["keys"]["comment"]
_MOST_REPAIRS = 8  # maximum number of syntax errors to cut off
_MOST_TEXTS = 64  # maximum number of values of a text that depends on conditions
_LONGEST = 1_000  # maximum length of a text (characters)
_MOST_INLINED = 500  # maximum number of inlined calls and unrolled rounds, which bounds the time
_START = re.compile(r"\s*(?:(?:async\s+)?def|class|if|while|for|import|from|@\w+|[\w.]+\s*[=(])(?!\w)")


@dataclass(frozen=True)
class _Choice:
    """A string that depends on a condition."""

    condition: Expression
    then: _Text
    otherwise: _Text
    count: int = field(init=False)  # of strings

    def __post_init__(self) -> None:
        count = sum(each.count if isinstance(each, _Choice) else 1 for each in (self.then, self.otherwise))
        if count > _MOST_TEXTS:
            raise ProgramError(f"a text must depend on few conditions; it has more than {_MOST_TEXTS} values")
        object.__setattr__(self, "count", count)


_Text: TypeAlias = str | _Choice
_Value: TypeAlias = Expression | _Text | list[ast.expr] | ast.Lambda | ast.Dict


class CodeReading(Reading):
    """A reader of Python functions, each of which becomes a section with a tree. Code that is cut off is repaired."""

    def __init__(self, text: str) -> None:
        super().__init__()
        for start, code in code_blocks(text):
            if (module := self.parse(code.expandtabs(4).splitlines(), start)) is not None:
                _Module(self, module)

    def parse(self, lines: list[str], start: int) -> ast.Module | None:
        """Parse lines, the first of which has the number ``start`` + 1; cut off what follows a syntax error."""
        first = next((number for number, line in enumerate(lines) if _START.match(line)), len(lines))
        lines[:first] = [""] * first
        head = "if True:" if first < len(lines) and lines[first][0] == " " else ""  # an additional line 0
        for _ in range(_MOST_REPAIRS):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # about invalid escapes in the text
                    module = ast.parse("\n".join([head, *lines]))
            except SyntaxError as error:
                end = max(0, min((error.lineno or 1) - 2, len(lines) - 1))
                while end > first and not lines[end].strip():
                    end -= 1
                if end <= first:
                    return None
                self.note(start + end + 1, f"the code is cut off here: {shown(lines[end].strip())}")
                del lines[end:]
                while lines and (not (last := lines[-1].partition("#")[0].rstrip()) or last.endswith(":")):
                    lines.pop()  # a block without a body
            except (ValueError, MemoryError, RecursionError):
                self.error = "the code nests too deeply"
                return None
            else:
                ast.increment_lineno(module, start - 1)
                return module
        return None


_Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef


class _Module:
    """The functions of a module. Functions that other functions call are inlined; each other one is a section."""

    def __init__(self, reading: Reading, module: ast.Module) -> None:
        self.reading, self.count, self.stack = reading, 0, list[str]()
        self.functions = {node.name: node for node in ast.walk(module) if isinstance(node, _Function)}
        called: set[str] = set()
        for name, function in self.functions.items():
            calls = (node for node in ast.walk(function) if isinstance(node, ast.Call))
            called |= {helper for call in calls if (helper := self.helper(call)) and helper != name}
        # The names of the fields of records, such as ``Rule(when, then)``.
        self.fields = {
            node.name: [
                each.target.id
                for each in node.body
                if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
            ]
            for node in ast.walk(module)
            if isinstance(node, ast.ClassDef)
        }
        # The constants of the module and its classes; a method's ``self.SIDE`` is the constant SIDE.
        self.constants = _Scope(self, {})
        classes = [node.body for node in module.body if isinstance(node, ast.ClassDef)]
        for node in (node for body in (module.body, *classes) for node in body):
            if isinstance(node, ast.Assign | ast.AnnAssign) and not isinstance(node.value, ast.Call | None):
                self.constants.statement(node)
        outside = [node for node in module.body if not isinstance(node, _Function | ast.ClassDef)]
        self.section("", 1, outside, {name for name in self.functions if name not in called})
        for name, function in self.functions.items():
            if name not in called:
                task = "" if is_for_any_task(name) else task_name(name)
                self.section(task, function.lineno, function.body, set())

    def helper(self, call: ast.Call) -> str:
        """Return the name of the function of this module that is called; "" if there is none."""
        function = call.func
        if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name) and function.value.id == "self":
            return function.attr if function.attr in self.functions else ""
        return function.id if isinstance(function, ast.Name) and function.id in self.functions else ""

    def section(self, task: str, line: int, body: Sequence[ast.stmt], roots: set[str]) -> None:
        """Add a section with the tree of the given statements, without calls to the functions in ``roots``."""
        tree = _Scope(self, dict(self.constants.values), roots).block(body)
        if next(actions_of(tree), None) is not None:
            self.reading.add_tree(task, line, tree)


class _Scope:
    """The statements of a function, with the values of its variables."""

    def __init__(self, module: _Module, values: dict[str, _Value], roots: Collection[str] = (), end: str = "") -> None:
        self.module, self.values, self.roots = module, values, roots
        self.end = end  # the label after the inlined function; "" for a function that is not inlined

    def note(self, node: ast.AST, text: str) -> None:
        self.module.reading.note(getattr(node, "lineno", 1), text)

    def left_out(self, node: ast.AST, reason: str) -> None:
        self.note(node, f"{shown(ast.unparse(node))} is left out: {reason}")

    # Statements

    def block(self, body: Sequence[ast.stmt]) -> Block:
        return Block(tuple(part for statement in body for part in self.statement(statement)))

    def branch(self, body: Sequence[ast.stmt]) -> tuple[Block, dict[str, _Value]]:
        """Return the tree of a branch, and the values of the variables after the branch."""
        before = dict(self.values)
        node, after = self.block(body), self.values
        self.values = before
        return node, after

    def statement(self, node: ast.stmt) -> list[Node]:
        """Return the parts that a statement adds to a block."""
        match node:
            case ast.Expr(value=value):
                return self.expression(value)
            case ast.Return(value=value):
                return [*(self.expression(value, is_returned=True) if value is not None else []), Jump(self.end)]
            case ast.If(orelse=orelse):
                chain = [node]
                while len(orelse) == 1 and isinstance(orelse[0], ast.If):  # a loop, since a chain may be long
                    chain.append(orelse[0])
                    orelse = orelse[0].orelse
                return [self.choice([(self.condition(each.test), each.body) for each in chain], orelse)]
            case ast.Match(subject=subject, cases=cases):
                tests = [(self.case(subject, case), case.body) for case in cases]
                return [self.choice(tests, [])]
            case ast.While(test=test, body=body, orelse=orelse):
                condition = self.condition(test)
                inner, self.values = self.branch(body)
                return [Loop(condition, inner), *self.block(orelse).parts]
            case ast.For(target=target, iter=iterated, body=body):
                return self.rounds(node, target, iterated, body)
            case ast.With(body=body) | ast.AsyncWith(body=body):
                return [*self.block(body).parts]
            case ast.Try(body=body, orelse=orelse, finalbody=final):
                return [*self.block([*body, *orelse, *final]).parts]
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                return self.assign(name, value)
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                pairs = [
                    (name.id, value) for name, value in zip(names, values, strict=False) if isinstance(name, ast.Name)
                ]
                return [part for name, value in pairs for part in self.assign(name, value)]
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                return self.assign(name, value)
            case ast.Break():
                return [Jump("break")]
            case ast.Continue() | ast.Raise():
                return [Jump()]
            case ast.AugAssign() | ast.Assign() | ast.Delete():
                self.left_out(node, "a plan has no memory")
        return []

    def choice(self, tests: Sequence[tuple[Expression, list[ast.stmt]]], otherwise: list[ast.stmt]) -> Node:
        """Return a branch for each (condition, statements); variables get values that depend on the conditions."""
        branches = [(condition, *self.branch(body)) for condition, body in tests]
        last = self.block(otherwise) if otherwise else None
        result: Node | None = last
        for condition, body, values in reversed(branches):
            for name, then in values.items():
                if (other := self.values.get(name)) is not then:
                    self.values[name] = _chosen(condition, then, other)
            result = Branch(condition, body, result)
        return result or Block()

    def case(self, subject: ast.expr, case: ast.match_case) -> Expression:
        """Return the condition of one ``case`` of a ``match``."""
        guard = TRUE if case.guard is None else self.condition(case.guard)
        return all_of([self.matches(subject, case.pattern), guard])

    def matches(self, subject: ast.expr, pattern: ast.pattern) -> Expression:
        match pattern:
            case ast.MatchAs(pattern=None):
                return TRUE
            case ast.MatchOr(patterns=patterns):
                return any_of(self.matches(subject, each) for each in patterns)
            case ast.MatchSequence(patterns=patterns) if isinstance(subject, ast.Tuple | ast.List):
                return all_of(self.matches(*pair) for pair in zip(subject.elts, patterns, strict=False))
            case ast.MatchSingleton(value=bool(value)):
                return self.condition(subject) if value else negate(self.condition(subject))
            case ast.MatchValue(value=value):
                return self.condition(ast.Compare(subject, [ast.Eq()], [value]))
        return as_expression(f"{ast.unparse(subject)} matches {ast.unparse(pattern)}")

    def rounds(self, node: ast.stmt, target: ast.expr, iterated: ast.expr, body: list[ast.stmt]) -> list[Node]:
        """Unroll a loop over written values; keep the body of any other loop once."""
        items = self.items(iterated)
        names = [each.id for each in getattr(target, "elts", [target]) if isinstance(each, ast.Name)]
        if items is None or not names:
            self.note(node, f"the body of 'for ... in {shown(ast.unparse(iterated))}' is kept once, without its count")
            return [*self.block(body).parts]
        parts = list[Node]()
        for each in items if self.count(len(items)) else ():
            pairs = zip(names, self.items(each) or [] if isinstance(target, ast.Tuple) else [each], strict=False)
            self.values |= {name: self.value(value) for name, value in pairs}
            parts += self.block(body).parts
        return parts

    def count(self, number: int) -> bool:
        """Count inlined parts, and return whether there are few enough."""
        self.module.count += number
        return self.module.count <= _MOST_INLINED

    def assign(self, name: str, value: ast.expr) -> list[Node]:
        if isinstance(value, ast.Await):
            value = value.value
        called = isinstance(value, ast.Call) and not self.module.helper(value) and self.argument(value) is None
        if called and self.is_action(value) and not _is_check(value):  # type: ignore[arg-type]
            return self.expression(value)
        self.values[name] = self.value(value)
        return []

    # Actions

    def expression(self, node: ast.expr, is_returned: bool = False) -> list[Node]:
        """Return the actions of an expression that is a statement, or that is returned."""
        match node:
            case ast.Await(value=value) | ast.Yield(value=ast.expr() as value):
                return self.expression(value, True)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                branches = [Block(tuple(self.expression(each, is_returned))) for each in (body, orelse)]
                return [Branch(self.condition(test), *branches)]
            case ast.Tuple(elts=values) | ast.List(elts=values) if is_returned:
                return [part for value in values for part in self.expression(value, True)]
            case ast.Call() if name := self.module.helper(node):
                return self.inline(node, name)
            case ast.Call(func=function) if isinstance(known := self.entry(function), ast.Lambda) and self.count(1):
                return self.expression(known.body, is_returned)
            case ast.Call() if self.text(node) is None:
                return self.call(node)
        text = self.text(node) if is_returned else None
        return [] if text is None else [_action(text, node.lineno)]

    def call(self, node: ast.Call) -> list[Node]:
        """Return the action of a call of a skill."""
        function = " ".join(words_of(_name(node.func)))
        if function in PYTHON["ignored"] or function.split(" ")[-1] in PYTHON["ignored"]:
            return []
        if not function or not self.is_action(node):
            self.left_out(node, "the call is not a skill")
            return []
        receiver, verb = self.receiver(node.func), words_of(_name(node.func))
        if _is_carrier(node):
            receiver, verb = "", [""]
        named = {
            each.arg: text for each in node.keywords if each.arg and (text := self.argument(each.value)) is not None
        }
        if verb == ["move", "gripper"]:
            place = [text for each in node.args if isinstance(text := self.argument(each), str)]
            flags = {each.arg: ast.unparse(each.value) for each in node.keywords if each.arg}
            skill, goal = state_to_reach(
                " ".join(place), flags | {k: v for k, v in named.items() if isinstance(v, str)}
            )
            return [Action(skill, node.lineno, goal)]
        goal = str(named.pop("goal", ""))
        parts: list[_Text] = [verb[0], receiver, " ".join(verb[1:])]
        parts += [text for each in node.args if (text := self.argument(each)) is not None]
        for name, text in named.items():
            if name in _COMMENTS:
                continue
            parts += [name.rstrip("_"), text] if name.rstrip("_") in PROGRAM_WORDS["prepositions"] else [text]
        return [_action(_joined(parts), node.lineno, goal)]

    def is_action(self, node: ast.Call) -> bool:
        """Return whether a call is a skill: a method of the robot, or a function whose first word is a verb."""
        root, dot, _ = ast.unparse(node.func).removeprefix("self.").partition(".")
        is_skill = is_verb(words_of(_name(node.func))[:1])
        return _is_carrier(node) or (root in PYTHON["robots"] or (is_skill and _is_owner(root)) if dot else is_skill)

    def receiver(self, node: ast.expr) -> _Text:
        """Return the words before a method's name, without the robot: "gripper" in ``robot.gripper.close()``."""
        return (self.argument(node.value) or "") if isinstance(node, ast.Attribute) else ""

    def argument(self, node: ast.expr) -> _Text | None:
        """Return the words of a call's argument; None for numbers and the like."""
        match node:
            case ast.Constant(value=value):
                return value if isinstance(value, str) else None
            case ast.Name(id=name) if name not in self.values:
                return None if _is_owner(name) else PYTHON["names"].get(name) or " ".join(words_of(name))
            case ast.Attribute(value=ast.Name(id="self"), attr=name) if name in self.module.constants.values:
                return self.argument(ast.Name(name))
            case ast.Attribute() | ast.Subscript() if self.entry(node) is not None:
                return self.text(node)
            case ast.Attribute(attr=name):
                words = [] if name in PYTHON["fields"] or _is_owner(name) else [" ".join(words_of(name))]
                return _joined([self.receiver(node), *words])
            case ast.Subscript(value=value, slice=key) if self.table(value) is None:
                return self.argument(key)
            case ast.Call() if words_of(_name(node.func))[:1] in (["get"], ["find"], ["object"]) and node.args:
                return self.argument(node.args[0])
        return self.text(node)

    def inline(self, node: ast.Call, name: str) -> list[Node]:
        """Return the actions of a helper function."""
        if name in self.roots:
            return []
        if (scope := self.inner(node, name)) is None:
            return []
        scope.end = f"return {self.module.count}"
        self.module.stack.append(name)
        body = scope.block(self.module.functions[name].body)
        self.module.stack.pop()
        return [body, Label(scope.end)]

    def inner(self, node: ast.Call, name: str) -> _Scope | None:
        """Return the scope of a called helper function; None if the function calls itself."""
        if name in self.module.stack or not self.count(1):
            self.left_out(node, "a function that calls itself" if name in self.module.stack else "too many calls")
            return None
        arguments = self.module.functions[name].args
        names = [each.arg for each in (*arguments.posonlyargs, *arguments.args) if each.arg not in ("self", "cls")]
        defaults = dict(zip(reversed(names), reversed(arguments.defaults), strict=False))
        written = (
            defaults | dict(zip(names, node.args, strict=False)) | {e.arg: e.value for e in node.keywords if e.arg}
        )
        values = {key: self.value(each) for key, each in written.items() if self.argument(each) != ""}
        outer = {key: value for key, value in self.values.items() if key not in names}
        return _Scope(self.module, outer | values)

    # Values

    def value(self, node: ast.expr) -> _Value:
        """Return the value of an expression: a text, a list, a table, a function, or otherwise a condition."""
        match node:
            case ast.Lambda() | ast.Dict():
                return node
            case ast.Call() if (table := self.table(node)) is not None:
                return table
            case ast.Constant(value=None):
                return ""
            case ast.Call() if name := self.module.helper(node):
                return self.called(node, name)
        text = self.argument(node)
        if text is not None:
            return text
        items = self.items(node)
        return self.condition(node) if items is None else items

    def table(self, node: ast.expr) -> ast.Dict | None:
        """Return a written dictionary; a record such as ``Rule(when=..., then=...)`` is one, too."""
        node = self.entry(node) or node
        if isinstance(node, ast.Call) and (fields := self.module.fields.get(_name(node.func))):
            pairs = dict(zip(fields, node.args, strict=False)) | {e.arg: e.value for e in node.keywords if e.arg}
            return ast.Dict([ast.Constant(name) for name in pairs], [*pairs.values()])
        return node if isinstance(node, ast.Dict) else None

    def entry(self, node: ast.expr) -> ast.expr | None:
        """Return the table or function that a name stands for, or the entry of a table at a written key."""
        match node:
            case ast.Name(id=name) | ast.Attribute(value=ast.Name(id="self"), attr=name):
                value = self.values.get(name)
                return value if isinstance(value, ast.expr) else None
            case ast.Attribute(value=ast.Name(id=owner), attr=name) if owner in self.module.fields:  # Phase.PUSH
                return ast.copy_location(ast.Name(name), node) if name in self.module.constants.values else None
            case ast.Attribute(value=owner, attr="value") if self.text(owner) is not None:  # of an enumeration
                return owner
            case ast.Attribute(value=owner, attr=key) | ast.Subscript(value=owner, slice=ast.Constant(value=key)):
                if (table := self.table(owner)) is not None:
                    pairs = zip(table.keys, table.values, strict=True)
                    return next((each for k, each in pairs if isinstance(k, ast.Constant) and k.value == key), None)
        return None

    def text_at(self, table: ast.Dict, key: _Value) -> _Text | None:
        """Return the text in a table for a key that may depend on conditions."""
        if isinstance(key, _Choice):
            then, otherwise = self.text_at(table, key.then), self.text_at(table, key.otherwise)
            return _Choice(key.condition, then or "", otherwise or "") if then or otherwise else None
        texts = {self.argument(each): value for each, value in zip(table.keys, table.values, strict=True) if each}
        return self.text(texts[key]) if isinstance(key, str) and key in texts else None

    def items(self, node: ast.expr) -> list[ast.expr] | None:
        """Return the elements of a written list."""
        if isinstance(node, ast.Name) and isinstance(value := self.values.get(node.id), list):
            return value
        return node.elts if isinstance(node, ast.List | ast.Tuple | ast.Set) else None

    def text(self, node: ast.expr) -> _Text | None:
        """Return the value of an expression that is a string; None for any other expression."""
        match node:
            case ast.Constant(value=str(value)):
                return value
            case ast.Name(id=name):
                known = self.values.get(name)
                return known if isinstance(known, str | _Choice) else None
            case ast.Attribute() | ast.Subscript() if (entry := self.entry(node)) is not None:
                return self.text(entry)
            case ast.Subscript(value=value, slice=key) if (table := self.table(value)) is not None:
                return self.text_at(table, self.value(key))
            case ast.Call() if name := self.module.helper(node):
                returned = self.called(node, name)
                return returned if isinstance(returned, str | _Choice) else None
            case ast.Call(func=ast.Attribute(value=value, attr="get"), args=[key, *_]) if table := self.table(value):
                return self.text_at(table, self.value(key))
            case ast.JoinedStr(values=values):
                return _joined([text for each in values if (text := self.argument(each)) is not None], "")
            case ast.FormattedValue(value=value):
                return self.argument(value)
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                pair = [self.text(left), self.text(right)]
                return None if None in pair else _joined([text for text in pair if text is not None], "")
            case ast.IfExp(test=test, body=body, orelse=orelse):
                then, otherwise = self.text(body), self.text(orelse)
                return None if then is None or otherwise is None else _Choice(self.condition(test), then, otherwise)
        return None

    def condition(self, node: ast.expr) -> Expression:
        """Return the condition of an expression. Code that is not a condition becomes a leaf with its source."""
        match node:
            case ast.Await(value=value):
                return self.condition(value)
            case ast.BoolOp(op=op, values=values):
                return (all_of if isinstance(op, ast.And) else any_of)(map(self.condition, values))
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return negate(self.condition(operand))
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return choose(*map(self.condition, (test, body, orelse)))
            case ast.NamedExpr(target=ast.Name(id=name), value=value):
                self.values[name] = self.condition(value)
                return self.condition(ast.Name(name))
            case ast.Constant(value=bool(value)):
                return TRUE if value else FALSE
            case ast.Constant(value=int(value)):
                return TRUE if value else FALSE
            case ast.Name(id=name) if isinstance(known := self.values.get(name), Expression):
                return known
            case ast.Compare(left=left, ops=[ast.Is() | ast.Eq()], comparators=[ast.Constant(value=bool(value))]):
                return self.condition(left) if value else negate(self.condition(left))
            case ast.Compare(left=ast.Call(args=[_, _]) as call, ops=[op]) if words_of(_name(call.func))[:1] in (
                ["distance"],
                ["dist"],
            ):
                pair = [text for each in call.args if (text := self.argument(each)) is not None]
                near = _leaf(_joined([*pair[:1], "near", *pair[1:]]))
                self.note(node, f"the threshold in {shown(ast.unparse(node))} is read as that of 'near'")
                return near if isinstance(op, ast.Lt | ast.LtE) else negate(near)
            case ast.Compare(left=ast.Name(id=name), ops=[op], comparators=[right]) if (
                isinstance(known := self.values.get(name), str | _Choice)
                and (isinstance(known, _Choice) or ast.unparse(right) == "None")
                and isinstance(other := self.value(right), str)
            ):
                equal = _equals(known, other)
                return negate(equal) if isinstance(op, ast.NotEq | ast.IsNot) else equal
            case ast.Compare(left=left, ops=[ast.Is() | ast.Eq() | ast.NotEq() as op], comparators=[right]):
                words = [self.argument(left), "is", self.argument(right)]
                if None not in words:
                    leaf = _leaf(_joined([word for word in words if word is not None]))
                    return negate(leaf) if isinstance(op, ast.NotEq) else leaf
            case ast.Call(func=ast.Name(id="any" | "all" as name), args=[argument]):
                return (any_of if name == "any" else all_of)(self.parts(argument))
            case ast.Call(func=ast.Name(id="bool"), args=[argument]):
                return self.condition(argument)
            case ast.Attribute() | ast.Subscript() if (entry := self.entry(node)) is not None:
                return self.condition(entry)
            case ast.Call(func=function, args=args) if isinstance(called := self.entry(function), ast.Lambda):
                names = [each.arg for each in called.args.args]
                inner = {key: self.value(each) for key, each in zip(names, args, strict=False)}
                return _Scope(self.module, self.values | inner).condition(called.body) if self.count(1) else FALSE
            case ast.Call() if name := self.module.helper(node):
                return _truth(self.called(node, name))
            case ast.Call() if (text := self.question(node)) is not None:
                return _leaf(text)
            case ast.Attribute() if self.module.helper(property := ast.Call(node, [], [])):
                return self.condition(ast.copy_location(property, node))
            case ast.Attribute() if (text := self.argument(node)) is not None:
                return _leaf(text)
        text = self.text(node)
        return as_expression(ast.unparse(node)) if text is None else _leaf(text)

    def parts(self, node: ast.expr) -> list[Expression]:
        """Return the conditions in the argument of ``any`` or ``all``."""
        if isinstance(node, ast.GeneratorExp | ast.ListComp) and len(node.generators) == 1:
            loop = node.generators[0]
            items = self.items(loop.iter)
            if items is not None and isinstance(loop.target, ast.Name) and self.count(len(items)):
                values = [{loop.target.id: self.value(each)} for each in items]
                return [_Scope(self.module, self.values | value).condition(node.elt) for value in values]
        items = self.items(node)
        return [self.condition(node)] if items is None else [self.condition(each) for each in items]

    def question(self, node: ast.Call) -> _Text | None:
        """Return the words of a call in a condition: "gripper is above puck" for ``gripper.is_above(puck)``."""
        words = [text for each in node.args if (text := self.argument(each)) is not None]
        words += [text for each in node.keywords if (text := self.argument(each.value)) is not None]
        is_sentence = len(words) > 2 or any(isinstance(each, str) and len(each.split()) > 3 for each in words)
        if words and (_is_check(node) or is_sentence):
            return _joined(words)
        receiver, name = self.receiver(node.func), words_of(_name(node.func))
        if len(words) > 1 or (words and not receiver and name[-1:] != ["holding"] and name[-1] not in _RELATIONS):
            receiver, *words = words
        return _joined([receiver, " ".join(name), *words]) or None

    def called(self, node: ast.Call, name: str) -> _Value:
        """Return the value that a helper function returns."""
        if (scope := self.inner(node, name)) is None:
            return as_expression(ast.unparse(node))
        self.module.stack.append(name)
        returned = scope.returned(self.module.functions[name].body)
        self.module.stack.pop()
        return returned

    def returned(self, body: Sequence[ast.stmt]) -> _Value:
        """Return the value that the statements of a function return."""
        for number, statement in enumerate(body):
            match statement:
                case ast.Return(value=value):
                    return FALSE if value is None else self.value(value)
                case ast.If(test=test, body=then, orelse=orelse):
                    rest, condition = body[number + 1 :], self.condition(test)
                    inner = _Scope(self.module, dict(self.values))
                    return _chosen(condition, inner.returned([*then, *rest]), self.returned([*orelse, *rest]))
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    self.values[name] = self.value(value)
        return FALSE


def _name(node: ast.expr) -> str:
    """Return the last name of an expression: "move_to" for ``robot.move_to``."""
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def _is_owner(name: str) -> bool:
    """Return whether a name stands for the robot or its observation, not for an object."""
    return name in PYTHON["owners"] or (len(name) == 1 and name not in PYTHON["names"])


def _is_carrier(node: ast.Call) -> bool:
    """Return whether the arguments of a call name the skill: ``robot.do("close the gripper")``."""
    return " ".join(words_of(_name(node.func))) in PYTHON["carriers"] and bool(node.args)


def _is_check(node: ast.Call) -> bool:
    """Return whether a call asks a question in words, such as ``check("...")``."""
    return " ".join(words_of(_name(node.func))) in PYTHON["checks"]


def _joined(parts: Sequence[_Text], gap: str = " ") -> _Text:
    """Join texts; a text that depends on a condition makes the result depend on it."""
    for number, part in enumerate(parts):
        if isinstance(part, _Choice):
            both = (_joined([*parts[:number], each, *parts[number + 1 :]], gap) for each in (part.then, part.otherwise))
            return _Choice(part.condition, *both)
    if sum(map(len, parts)) > _LONGEST:  # type: ignore[arg-type]
        raise ProgramError(f"a text must have at most {_LONGEST} characters")
    return gap.join(str(part) for part in parts if part != "")


def _leaf(text: _Text) -> Expression:
    """Return a condition in words."""
    if isinstance(text, _Choice):
        return choose(text.condition, _leaf(text.then), _leaf(text.otherwise))
    return as_expression(" ".join(text.split())) if text else FALSE


def _equals(text: _Text, other: str) -> Expression:
    """Return the condition that a text is equal to another one."""
    if isinstance(text, _Choice):
        return choose(text.condition, _equals(text.then, other), _equals(text.otherwise, other))
    return TRUE if text == other else FALSE


def _truth(value: _Value) -> Expression:
    """Return a value as a condition."""
    return _leaf(value) if isinstance(value, str | _Choice) else value if isinstance(value, Expression) else FALSE


def _action(text: _Text, line: int, goal: str = "") -> Node:
    if isinstance(text, _Choice):
        return Branch(text.condition, _action(text.then, line, goal), _action(text.otherwise, line, goal))
    return Action(" ".join(text.split()), line, goal) if text or goal else Block()


def _chosen(condition: Expression, then: _Value, otherwise: _Value | None) -> _Value:
    """Return the value of a variable after a branch."""
    if isinstance(then, Expression) or isinstance(otherwise, Expression):
        return then if otherwise is None else choose(condition, _truth(then), _truth(otherwise))
    if isinstance(then, str | _Choice) and isinstance(otherwise, str | _Choice) and then != otherwise:
        return _Choice(condition, then, otherwise)
    return then
