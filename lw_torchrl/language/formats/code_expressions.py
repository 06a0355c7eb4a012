"""Convert expressions in Python code to texts, conditions and other values."""

from __future__ import annotations

import ast
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, Self

from lw_torchrl._util.checks import shown
from lw_torchrl.language.expressions import FALSE, TRUE, Expression, all_of, any_of, as_expression, negate
from lw_torchrl.language.formats.base import PROGRAM_WORDS, is_near, words_of
from lw_torchrl.language.formats.code_values import (
    Choice,
    Distance,
    Name,
    Text,
    Value,
    constant,
    each_text,
    joined,
    leaf,
    lookup,
    truth,
)
from lw_torchrl.language.formats.phrases import is_noun
from lw_torchrl.language.programs import choose

if TYPE_CHECKING:
    from lw_torchrl.language.formats.code import Module

PYTHON = PROGRAM_WORDS["python"]
_RELATIONS = [*PROGRAM_WORDS["prepositions"], "of", "aligned"]  # the last words of relations
_MOST_INLINED = 500  # maximum number of inlined calls and unrolled rounds, to bound the time


class Expressions:
    """A converter of the expressions in a function, with the values of the function's variables."""

    def __init__(self, module: Module, values: dict[str, Value], roots: Collection[str] = (), end: str = "") -> None:
        self.module, self.values, self.roots = module, values, roots
        self.end = end  # the label after the inlined function; "" for a function that is not inlined

    def note(self, node: ast.AST, text: str) -> None:
        self.module.reading.note(getattr(node, "lineno", 1), text)

    def left_out(self, node: ast.AST, reason: str) -> None:
        self.note(node, f"{shown(ast.unparse(node))} is left out: {reason}")

    def count(self, number: int) -> bool:
        """Add to the count of inlined parts, and return whether it is within the limit."""
        self.module.count += number
        return self.module.count <= _MOST_INLINED

    def receiver(self, node: ast.expr) -> Text:
        """Return the words before a method's name, without the robot: "gripper" in ``robot.gripper.close()``."""
        return (self.words(node.value) or "") if isinstance(node, ast.Attribute) else ""

    def arguments(self, node: ast.Call) -> tuple[list[Text], dict[str, Text]]:
        """Return the words of a call's positional arguments, and those of its keyword arguments by name."""
        words = [text for each in node.args if (text := self.words(each)) is not None]
        pairs = [(each.arg, self.words(each.value)) for each in node.keywords if each.arg]
        return words, {name: text for name, text in pairs if text is not None}

    def inner(self, node: ast.Call, name: str) -> Self | None:
        """Return the scope of a called helper function; None if it calls itself or too many calls are inlined."""
        if name in self.module.stack or not self.count(1):
            self.left_out(node, "a function that calls itself" if name in self.module.stack else "too many calls")
            return None
        arguments = self.module.functions[name].args
        names = [each.arg for each in (*arguments.posonlyargs, *arguments.args) if each.arg not in ("self", "cls")]
        defaults = dict(zip(reversed(names), reversed(arguments.defaults), strict=False))
        written = defaults | dict(zip(names, node.args, strict=False))
        written |= {each.arg: each.value for each in node.keywords if each.arg}
        values = {key: self.value(each) for key, each in written.items()}
        values = {key: value for key, value in values.items() if value is not None or name_of(written[key]) == ""}
        outer = {key: value for key, value in self.values.items() if key not in names}
        return type(self)(self.module, outer | values)

    def words(self, node: ast.expr) -> Text | None:
        """Return the text of an expression; None for an expression without words, such as a number."""
        value = self.value(node)
        return value if isinstance(value, str | Choice) else None

    def condition(self, node: ast.expr) -> Expression:
        """Convert an expression to a condition. Code that cannot be converted becomes a leaf with the source text."""
        value = self.value(node)
        return truth(value) if isinstance(value, Expression | str | Choice) else as_expression(ast.unparse(node))

    def value(self, node: ast.expr) -> Value:
        """Return the value of an expression; None if it has no meaning in a plan."""
        match node:
            case ast.Await(value=value) | ast.FormattedValue(value=value):
                return self.value(value)
            case ast.Constant(value=value):
                return value if isinstance(value, str) else "" if value is None else constant(value)
            case ast.Lambda():
                return node
            case ast.List(elts=parts) | ast.Tuple(elts=parts) | ast.Set(elts=parts):
                return [self.value(part) for part in parts]
            case ast.Dict(keys=keys, values=values):
                return {self.key(key): self.value(each) for key, each in zip(keys, values, strict=True) if key}
            case ast.Name(id=name):
                words = words_of(name)
                words = words[:-1] if len(words) > 1 and words[-1] in PYTHON["fields"] else words  # "mug_pos"
                unknown = PYTHON["names"].get(name) or " ".join(words)
                return self.values[name] if name in self.values else None if is_owner(name) else Name(unknown)
            case ast.Attribute() | ast.Subscript():
                return self.part(node)
            case ast.Call():
                return self.result(node)
            case ast.JoinedStr(values=values):
                return joined([text for each in values if (text := self.words(each)) is not None], "")
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                texts = [text for each in (left, right) if (text := self.words(each)) is not None]
                return joined(texts, "") if len(texts) == 2 else None
            case ast.IfExp(test=test, body=body, orelse=orelse):
                then, otherwise = self.words(body), self.words(orelse)
                if then is not None and otherwise is not None:
                    return Choice(self.condition(test), then, otherwise)
                return choose(*map(self.condition, (test, body, orelse)))
            case ast.NamedExpr(target=ast.Name(id=name), value=value):
                self.values[name] = self.value(value)
                return self.values[name]
            case ast.BoolOp(op=op, values=values):
                return (all_of if isinstance(op, ast.And) else any_of)(map(self.condition, values))
            case (
                ast.UnaryOp(op=ast.Not() | ast.Invert(), operand=operand)
                | ast.BinOp(left=ast.Constant(value=1), op=ast.Sub(), right=operand)
            ):
                return negate(self.condition(operand))
            case ast.BinOp(left=left, op=ast.BitXor(), right=right):
                one, other = self.condition(left), self.condition(right)
                return choose(one, negate(other), other)
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return self.comparison(node, left, op, right)
        return None

    def key(self, node: ast.expr) -> Any:
        """Return the value of a key in a table."""
        return node.value if isinstance(node, ast.Constant) else self.words(node)

    def part(self, node: ast.Attribute | ast.Subscript) -> Value:
        """Return an entry of a table or record, the value of a property, or else the words of ``env.puck``."""
        owner = self.value(node.value)
        if isinstance(node, ast.Subscript):
            if isinstance(node.slice, ast.Slice):
                return owner
            return lookup(owner, self.key(node.slice)) if isinstance(owner, dict) else self.value(node.slice)
        if isinstance(owner, dict) and node.attr in owner:
            return owner[node.attr]
        if self.module.helper(call := ast.copy_location(ast.Call(node, [], []), node)):
            return self.value(call)
        if name_of(node.value) in ("self", *self.module.fields) and node.attr in self.module.constants.values:
            return self.values.get(node.attr)
        is_named = node.attr not in PYTHON["fields"] and not is_owner(node.attr)
        words = joined([self.receiver(node), " ".join(words_of(node.attr)) if is_named else ""])
        return Name(words) if words and isinstance(words, str) else words or None

    def result(self, node: ast.Call) -> Value:
        """Return the result of calling a helper, a Python built-in, a table's ``get``, or a check of the scene."""
        if name := self.module.helper(node):
            return self.called(node, name)
        if fields := self.module.fields.get(name_of(node.func)):
            pairs = dict(zip(fields, node.args, strict=False)) | {
                each.arg: each.value for each in node.keywords if each.arg
            }
            return {key: self.value(each) for key, each in pairs.items()}
        match node:
            case ast.Call(func=ast.Name(id="any" | "all" as name), args=[argument]):
                return (any_of if name == "any" else all_of)(self.parts(argument))
            case ast.Call(func=ast.Name(id="bool" | "int" | "float" | "abs" | "str"), args=[argument]):
                return self.value(argument)
            case ast.Call(func=ast.Attribute(value=owner, attr="get"), args=[key, *default]) if isinstance(
                table := self.value(owner), dict
            ):
                return lookup(table, self.key(key), self.value(default[0]) if default else None)
            case ast.Call(func=ast.Attribute(attr="norm"), args=[ast.BinOp(left=left, op=ast.Sub(), right=right)]):
                return self.distance(left, right)
            case ast.Call(args=[left, right]) if {"dist", "distance"} & {*words_of(name_of(node.func))}:
                return self.distance(left, right)
            case ast.Call(args=[argument, *_]) if words_of(name_of(node.func))[:1] in (["get"], ["find"], ["object"]):
                text = self.words(argument)
                return Name(text) if isinstance(text, str) else text
            case ast.Call(func=function, args=args) if isinstance(called := self.value(function), ast.Lambda):
                inner = {each.arg: self.value(value) for each, value in zip(called.args.args, args, strict=False)}
                return type(self)(self.module, self.values | inner).value(called.body) if self.count(1) else FALSE
        if (text := self.question(node)) is None:
            return None
        return negate(leaf(text)) if _reverses(node, text) else leaf(text)

    def distance(self, *nodes: ast.expr) -> Distance | None:
        pair = [self.words(each) for each in nodes]
        is_flat = all(isinstance(each, ast.Subscript) and ast.unparse(each.slice) == ":2" for each in nodes)
        relation = "vertically aligned with" if is_flat else "near"
        return Distance(*pair, relation) if all(pair) else None  # type: ignore[arg-type, call-arg]

    def comparison(self, node: ast.Compare, left: ast.expr, op: ast.cmpop, right: ast.expr) -> Expression | None:
        """Convert a comparison with a truth value, a threshold, or the text of a variable to a condition."""
        differs = isinstance(op, ast.NotEq | ast.IsNot)
        is_equality = differs or isinstance(op, ast.Eq | ast.Is)
        value, other = self.value(left), self.value(right)
        condition: Expression | None = None
        number = right.value if isinstance(right, ast.Constant) else None
        if is_equality and (isinstance(number, bool) or (number in (0, 1) and isinstance(left, ast.Call))):
            condition = self.condition(left)
            differs ^= not number  # int(check("...")) == 0
        elif isinstance(op, ast.Lt) and number == 1 and isinstance(value, Expression):
            condition, differs = value, True
        elif isinstance(value, Distance):
            threshold = self.module.numbers.get(name_of(right), number)
            if isinstance(threshold, int | float) and not is_near(threshold):
                return None
            condition = leaf(joined([value.first, value.relation, value.second]))
            differs = not isinstance(op, ast.Lt | ast.LtE)
            self.note(node, f"the threshold in {shown(ast.unparse(node))} is read as that of {value.relation!r}")
        elif isinstance(value, Choice | str) and isinstance(other, Choice | str):
            is_known = isinstance(value, Choice) or (ast.unparse(right) == "None" and not isinstance(value, Name))
            if is_known and isinstance(other, str):
                condition = each_text(value, lambda each: TRUE if each == other else FALSE, choose)
            elif is_equality and ast.unparse(right) != "None":
                condition = leaf(joined([value, "is", other]))
        return condition if condition is None or not differs else negate(condition)

    def parts(self, node: ast.expr) -> list[Expression]:
        """Return the conditions in the argument of ``any`` or ``all``."""
        if isinstance(node, ast.GeneratorExp | ast.ListComp) and len(node.generators) == 1:
            loop = node.generators[0]
            items = self.value(loop.iter)
            if isinstance(items, list) and isinstance(loop.target, ast.Name) and self.count(len(items)):
                scopes = (type(self)(self.module, self.values | {loop.target.id: each}) for each in items)
                return [scope.condition(node.elt) for scope in scopes]
        items = self.value(node)
        return [*map(truth, items)] if isinstance(items, list) else [self.condition(node)]

    def question(self, node: ast.Call) -> Text | None:
        """Return the words of a call in a condition: "gripper is above puck" for ``gripper.is_above(puck)``."""
        words, named = self.arguments(node)
        manner = [text for name, text in named.items() if name in PYTHON["manners"]]
        words += [text for name, text in named.items() if name not in PYTHON["manners"]]
        is_sentence = len(words) > 2 or any(isinstance(each, str) and len(each.split()) > 3 for each in words)
        if words and (is_check(node) or is_sentence):
            return joined(words)
        receiver, name = self.receiver(node.func), words_of(name_of(node.func)) or [""]
        name += ["from"] * (name[-1] == "far")
        if words and name[-1] not in _RELATIONS and not is_noun(str(receiver)) and is_noun(str(words[0])):
            receiver = ""  # "vision.is_closed(gripper)"
        if len(words) > 1 or (words and not receiver and name[-1:] != ["holding"] and name[-1] not in _RELATIONS):
            receiver, *words = words
        return joined([receiver, *manner, " ".join(name), *words]) or None

    def called(self, node: ast.Call, name: str) -> Value:
        """Return the value that a helper function returns."""
        if (scope := self.inner(node, name)) is None:
            return as_expression(ast.unparse(node))
        self.module.stack.append(name)
        returned = scope.returned(self.module.functions[name].body)
        self.module.stack.pop()
        return returned

    def returned(self, body: Sequence[ast.stmt]) -> Value:
        """Return the value that the statements of a function return."""
        raise NotImplementedError


def _reverses(call: ast.Call, text: Text) -> bool:
    """Return whether a call checks the opposite of ``text``: check_not("..."), check("...", expected=False)."""
    last = (words_of(name_of(call.func)) or [""])[-1]
    reverses = last in PYTHON["reversed"] and last not in str(text).split()
    for each in call.keywords:
        if isinstance(each.value, ast.Constant) and isinstance(value := each.value.value, bool):
            key = (each.arg or "").rstrip("_")
            reverses ^= value if key in PYTHON["negates"] else not value and key in PYTHON["expects"]
    return reverses


def name_of(node: ast.expr) -> str:
    """Return the last name of an expression: "move_to" for ``robot.move_to``."""
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def is_owner(name: str) -> bool:
    """Return whether a name stands for the robot or its observation, not for an object."""
    return name in PYTHON["owners"] or (len(name) == 1 and name not in PYTHON["names"])


def is_carrier(node: ast.Call) -> bool:
    """Return whether the arguments of a call name the skill: ``robot.do("close the gripper")``."""
    return " ".join(words_of(name_of(node.func))) in PYTHON["carriers"] and bool(node.args)


def is_check(node: ast.Call) -> bool:
    """Return whether a call asks a question in words, such as ``check("...")``."""
    words = words_of(name_of(node.func))
    words = words[:-1] if len(words) > 1 and words[-1] in PYTHON["reversed"] else words
    return " ".join(words) in PYTHON["checks"]
