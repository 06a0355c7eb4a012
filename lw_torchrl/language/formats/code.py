"""A reader of plans that are Python functions with control flow. The text is parsed, never executed."""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Sequence
from typing import TypeAlias

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import FALSE, TRUE, Expression, all_of, any_of, as_expression, negate
from lw_torchrl.language.formats.base import (
    PROGRAM_WORDS,
    Reading,
    Section,
    code_blocks,
    is_for_any_task,
    is_verb,
    task_name,
    words_of,
)
from lw_torchrl.language.formats.code_expressions import PYTHON, Expressions, is_carrier, is_check, is_owner, name_of
from lw_torchrl.language.formats.code_values import Choice, Name, Text, Value, action, chosen, joined
from lw_torchrl.language.formats.python import state_to_reach
from lw_torchrl.language.programs import Action, Block, Branch, Jump, Label, Loop, Node, actions_of

_COMMENTS = PROGRAM_WORDS["keys"]["comment"]
_MOST_REPAIRS = 8  # maximum number of syntax errors to repair by cutting off code
_START = re.compile(r"\s*(?:(?:async\s+)?def|class|if|while|for|import|from|@\w+|[\w.]+\s*[=(])(?!\w)")


class CodeReading(Reading):
    """A reader of Python code: each function that no other function calls becomes a section with a tree. Incomplete
    code is repaired."""

    def __init__(self, text: str) -> None:
        super().__init__()
        for start, code in code_blocks(text):
            if (module := self.parse(code.expandtabs(4).splitlines(), start)) is not None:
                Module(self, module).note_unread(module)

    def parse(self, lines: list[str], start: int) -> ast.Module | None:
        """Parse lines of code, which are numbered from ``start`` + 1, and cut off the code after a syntax error."""
        first = next((number for number, line in enumerate(lines) if _START.match(line)), len(lines))
        lines[:first] = [""] * first
        lines = [re.sub(r"^(\s*)pass (?=if\b.+\belse\b)", r"\1None ", line) for line in lines]  # a common mistake
        head = "if True:" if first < len(lines) and lines[first][0] == " " else ""  # becomes line 0
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


class Module:
    """The functions of a module. Functions that other functions call are inlined; all others become sections."""

    def __init__(self, reading: Reading, module: ast.Module) -> None:
        self.reading, self.count, self.stack = reading, 0, list[str]()
        self.functions = {node.name: node for node in ast.walk(module) if isinstance(node, _Function)}
        called: set[str] = set()
        for name, function in self.functions.items():
            calls = (node for node in ast.walk(function) if isinstance(node, ast.Call))
            called |= {helper for call in calls if (helper := self.helper(call)) and helper != name}
        classes = {node.name: node.body for node in ast.walk(module) if isinstance(node, ast.ClassDef)}
        self.numbers = {
            name_of(node.targets[0]): node.value.value
            for node in ast.walk(module)
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        }
        # The field names of records, such as ``Rule(when, then)``.
        self.fields = {
            name: [name_of(each.target) for each in body if isinstance(each, ast.AnnAssign)]
            for name, body in classes.items()
        }
        # The constants of the module and its classes; a method's ``self.SIDE`` is the constant SIDE.
        self.constants = _Scope(self, {})
        for node in (node for body in (module.body, *classes.values()) for node in body):
            if isinstance(node, ast.Assign | ast.AnnAssign) and not isinstance(node.value, ast.Call | None):
                self.constants.statement(node)
        outside = [node for node in module.body if not isinstance(node, _Function | ast.ClassDef)]
        self.section("", 1, outside, {name for name in self.functions if name not in called})
        for name, function in self.functions.items():
            if name not in called:
                task = "" if is_for_any_task(name) else task_name(name)
                self.section(task, function.lineno, function.body, set())

    def note_unread(self, module: ast.Module) -> None:
        """Append a note for each action that neither a program nor another note contains. An action is a call of a
        robot's method, or a string that begins with a verb."""
        actions = [action for section in self.reading.sections for action in actions_of(section.tree)]
        lines = {action.line for action in actions} | {note.line for note in self.reading.notes}
        known = "\n".join([each.text.lower() for each in actions] + [note.text.lower() for note in self.reading.notes])
        docstrings = {id(node.value) for node in ast.walk(module) if isinstance(node, ast.Expr)}
        for node in ast.walk(module):
            match node:
                case ast.Constant(value=str(text), lineno=line) if (
                    id(node) not in docstrings
                    and 1 < len(words := text.lower().split()) <= 40
                    and is_verb(words)
                    and " ".join(words) not in known
                ):
                    self.reading.note(line, f"no step has the action {shown(text)}")
                case ast.Call(func=ast.Attribute(value=ast.Name(id=owner), attr=verb), lineno=line) if (
                    owner in PYTHON["robots"] and is_verb(words_of(verb)) and line not in lines
                ):
                    self.reading.note(line, f"{shown(ast.unparse(node))} is left out, because no path reaches it")

    def helper(self, call: ast.Call) -> str:
        """Return the name of the called function if this module defines it, otherwise ""."""
        function = call.func
        if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name) and function.value.id == "self":
            return function.attr if function.attr in self.functions else ""
        return function.id if isinstance(function, ast.Name) and function.id in self.functions else ""

    def section(self, task: str, line: int, body: Sequence[ast.stmt], roots: set[str]) -> None:
        """Add a section with the tree of the given statements, without calls to the functions in ``roots``."""
        tree = _Scope(self, dict(self.constants.values), roots).block(body)
        if next(actions_of(tree), None) is not None:
            self.reading.sections.append(Section(task, line, tree=tree))


class _Scope(Expressions):
    """The statements of a function, with the values of its variables."""

    def block(self, body: Sequence[ast.stmt]) -> Block:
        return Block(tuple(part for statement in body for part in self.statement(statement)))

    def branch(self, body: Sequence[ast.stmt]) -> tuple[Block, dict[str, Value]]:
        """Return the tree of a branch, and the values of the variables after the branch."""
        before = dict(self.values)
        node, after = self.block(body), self.values
        self.values = before
        return node, after

    def statement(self, node: ast.stmt) -> list[Node]:
        """Return the nodes that a statement adds to a program."""
        match node:
            case ast.Expr(value=value):
                return self.expression(value)
            case ast.Return(value=value):
                return [*(self.expression(value, is_returned=True) if value is not None else []), Jump(self.end)]
            case ast.Assert(test=test) if any(map(_is_order, ast.walk(test))):
                self.left_out(node, "whether an assertion commands its action is unknown")
                return []
            case ast.Assert(test=test):  # the rest of the function runs only if the test is true
                return [Branch(negate(self.condition(test)), Jump(self.end))]
            case ast.If() | ast.Match():
                return [self.choice(*self.alternatives(node))]
            case ast.While(test=test, body=body, orelse=orelse):
                condition = self.condition(test)
                inner, self.values = self.branch(body)
                return [Loop(condition, inner), *self.block(orelse).parts]
            case ast.For(target=target, iter=iterated, body=body):
                return self.rounds(node, target, iterated, body)
            case ast.With(items=[ast.withitem(ast.Call(func=ast.Name(id=word), args=[test]))], body=body) if (
                word in PYTHON["guards"]
            ):
                return [Branch(self.guard(word, test), self.block(body))]
            case ast.With(body=body) | ast.AsyncWith(body=body):
                return [*self.block(body).parts]
            case ast.Try(body=body, orelse=orelse, finalbody=final):
                return [*self.block([*body, *orelse, *final]).parts]
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                return self.assign(name, value)
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                pairs = zip(names, values, strict=False)
                return [part for name, value in pairs for part in self.assign(name_of(name), value)]
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                return self.assign(name, value)
            case ast.Break():
                return [Jump("break")]
            case ast.Raise():
                return [Jump(self.end)]
            case ast.Continue():
                return [Jump()]
            case ast.AugAssign() | ast.Assign() | ast.Delete():
                self.left_out(node, "a plan has no memory")
        return []

    def alternatives(self, node: ast.If | ast.Match) -> tuple[list[tuple[Expression, list[ast.stmt]]], list[ast.stmt]]:
        """Return the (condition, statements) pairs of a choice, and the statements after the last "else"."""
        if isinstance(node, ast.Match):
            return [(self.case(node.subject, case), case.body) for case in node.cases], []
        tests, rest = list[tuple[Expression, list[ast.stmt]]](), list[ast.stmt]([node])
        while len(rest) == 1 and isinstance(branch := rest[0], ast.If):  # a loop, since a chain may be long
            tests.append((self.condition(branch.test), branch.body))
            rest = branch.orelse
        return tests, rest

    def choice(self, tests: Sequence[tuple[Expression, list[ast.stmt]]], otherwise: list[ast.stmt]) -> Node:
        """Convert (condition, statements) pairs to nested branches; variables assigned in them become conditional."""
        branches = [(condition, *self.branch(body)) for condition, body in tests]
        last = self.block(otherwise) if otherwise else None
        result: Node | None = last
        for condition, body, values in reversed(branches):
            for name, then in values.items():
                if (other := self.values.get(name)) is not then:
                    self.values[name] = chosen(condition, then, other)
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
        """Unroll a loop over literals; for any other loop, return the body once."""
        items = self.value(iterated)
        names = [each.id for each in getattr(target, "elts", [target]) if isinstance(each, ast.Name)]
        if not isinstance(items, list) or not names:
            self.note(node, f"the body of 'for ... in {shown(ast.unparse(iterated))}' is kept once instead of repeated")
            return [*self.block(body).parts]
        parts = list[Node]()
        for each in items if self.count(len(items)) else ():
            values = [each] if isinstance(target, ast.Name) else each if isinstance(each, list) else []
            self.values |= dict(zip(names, values, strict=False))
            parts += self.block(body).parts
        return parts

    def assign(self, name: str, value: ast.expr) -> list[Node]:
        value = value.value if isinstance(value, ast.Await) else value
        called = isinstance(value, ast.Call) and not self.module.helper(value) and self.words(value) is None
        if called and self.is_action(value) and not is_check(value):  # type: ignore[arg-type]
            return self.expression(value)
        self.values[name] = self.value(value)
        return []

    # Actions

    def expression(self, node: ast.expr, is_returned: bool = False) -> list[Node]:
        """Return the actions of an expression that is a statement or the value of a ``return``."""
        match node:
            case ast.Await(value=value) | ast.Yield(value=ast.expr() as value):
                return self.expression(value, True)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                branches = [Block(tuple(self.expression(each, is_returned))) for each in (body, orelse)]
                return [Branch(self.condition(test), *branches)]
            case ast.BoolOp(op=ast.And(), values=[*first, last]):  # "check(...) and robot.close(...)"
                return [Branch(all_of(map(self.condition, first)), Block(tuple(self.expression(last, is_returned))))]
            case ast.BoolOp(values=operands):
                return [self.first(operands)]
            case ast.Tuple(elts=values) | ast.List(elts=values) if is_returned:
                return [part for value in values for part in self.expression(value, True)]
            case ast.Call() if name := self.module.helper(node):
                return self.inline(node, name)
            case ast.Call(keywords=named) if guards := [each for each in named if each.arg in PYTHON["guards"]]:
                bare = ast.copy_location(ast.Call(node.func, node.args, [x for x in named if x not in guards]), node)
                tests = [self.guard(str(each.arg), each.value) for each in guards]
                return [Branch(all_of(tests), Block(tuple(self.expression(bare, is_returned))))]
            case ast.Call(func=function) if isinstance(known := self.value(function), ast.Lambda) and self.count(1):
                return self.expression(known.body, is_returned)
            case ast.Call(func=ast.Attribute(value=owner, attr="get")) if isinstance(self.value(owner), dict):
                pass
            case ast.Call():
                return self.call(node)
        text = self.words(node) if is_returned else None
        return [] if text is None or isinstance(text, Name) else [action(text, node.lineno)]

    def first(self, values: Sequence[ast.expr]) -> Node:
        """Convert "grasp(...) or lift(...) or 'wait'" to a program that runs the first truthy operand."""
        result: Node = Block()
        for each in reversed(values):
            text = self.value(each)
            if isinstance(text, str | Choice) and not isinstance(text, Name):
                result = action(text, each.lineno, otherwise=result)
            elif isinstance(text, Expression) and (not isinstance(each, ast.Call) or is_check(each)):
                result = Branch(negate(text), result)  # "check(...) or robot.grasp(...)"
            else:
                result = Block((*self.expression(each, True), result))
        return result

    def call(self, node: ast.Call) -> list[Node]:
        """Convert the call of a skill to actions."""
        verb = words_of(name_of(node.func))
        if not {" ".join(verb), *verb[-1:]}.isdisjoint(PYTHON["ignored"]):
            return []
        if not verb or not self.is_action(node):
            self.left_out(node, "the call is not a skill")
            return []
        receiver, verb = ("", [""]) if is_carrier(node) else (self.receiver(node.func), verb)
        words, named = self.arguments(node)
        if verb == ["move", "gripper"]:
            flags = {each.arg: ast.unparse(each.value) for each in node.keywords if each.arg}
            texts = {name: text for name, text in named.items() if isinstance(text, str)}
            place = " ".join(text for text in words if isinstance(text, str))
            skill, goal = state_to_reach(place, flags | texts)
            return [Action(skill, node.lineno, goal)]
        goal = str(named.pop("goal", ""))
        parts: list[Text] = [verb[0], receiver, " ".join(verb[1:]), *words]
        for name, text in named.items():
            if name in _COMMENTS:
                continue
            parts += [name.rstrip("_"), text] if name.rstrip("_") in PROGRAM_WORDS["prepositions"] else [text]
        return [action(joined(parts), node.lineno, goal)]

    def is_action(self, node: ast.Call) -> bool:
        """Return whether a call is a skill: a method of the robot, or a function whose name begins with a verb."""
        root, dot, _ = ast.unparse(node.func).removeprefix("self.").partition(".")
        is_skill = is_verb(words_of(name_of(node.func))[:1])
        return is_carrier(node) or (root in PYTHON["robots"] or (is_skill and is_owner(root)) if dot else is_skill)

    def inline(self, node: ast.Call, name: str) -> list[Node]:
        """Return the actions of a helper function."""
        if name in self.roots or (scope := self.inner(node, name)) is None:
            return []
        scope.end = f"return {self.module.count}"
        self.module.stack.append(name)
        body = scope.block(self.module.functions[name].body)
        self.module.stack.pop()
        return [body, Label(scope.end)]

    def guard(self, word: str, test: ast.expr) -> Expression:
        """Apply a word such as "unless" to a test, and return the resulting condition."""
        return negate(self.condition(test)) if word == "unless" else self.condition(test)

    def returned(self, body: Sequence[ast.stmt]) -> Value:
        """Return the value that the statements of a function return."""
        for number, statement in enumerate(body):
            match statement:
                case ast.Return(value=value):
                    return FALSE if value is None else self.value(value)
                case ast.If() | ast.Match():
                    (tests, otherwise), rest = self.alternatives(statement), body[number + 1 :]
                    scopes = [(test, then, _Scope(self.module, dict(self.values))) for test, then in tests]
                    branches = [(test, scope.returned([*then, *rest])) for test, then, scope in scopes]
                    returned = self.returned([*otherwise, *rest])
                    for test, then in reversed(branches):
                        returned = chosen(test, then, returned)
                    return returned
                case (
                    ast.Assign(targets=[ast.Name(id=name)], value=value)
                    | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value)
                ):
                    self.values[name] = self.value(value)
        return FALSE


def _is_order(node: ast.AST) -> bool:
    """Return whether a node calls a skill of the robot by its verb: ``robot.open("the gripper")``."""
    match node:
        case ast.Call(func=ast.Attribute(value=ast.Name(id=owner), attr=verb), args=[_, *_]):
            return owner in PYTHON["robots"] and is_verb(words_of(verb))
    return False
