"""Compile the expressions of many tasks to gates: index tensors that are evaluated for a whole batch at once.

A gate is a conjunction; its operands are leaves, other gates, or negations of these. A disjunction is a negated gate. A
part that several expressions share becomes a single gate. The gates of a level depend only on lower levels and are
evaluated together. The last level has one gate for each expression.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from lw_torchrl.language.expressions import FALSE, Expression, fold, negate

Truth = Literal["exact", "min-max", "product"]
"""How gates combine values. With "exact", values are bool. Otherwise values are logits: NOT flips the sign, and AND is
the minimum of the logits ("min-max") or the logit of the product of the probabilities ("product")."""


def inner_gates(expressions: Iterable[Expression]) -> dict[Expression, int]:
    """Return the conjunctions inside expressions, each with its level from 0, ordered by level.

    A disjunction "a or b" is returned as the conjunction "not a and not b". Top-level conjunctions are left out.
    """
    levels: dict[Expression, int] = {}
    for expression in expressions:

        def visit(each: Expression, parts: list[int], whole: Expression = expression) -> int:
            if each.kind == "leaf" or each == FALSE:
                return -1
            level = 1 + max(parts, default=-1)
            if each != whole or each.kind == "any":
                levels[each if each.kind == "all" else negate(each)] = level
            return level

        fold(expression, visit)
    return dict(sorted(levels.items(), key=lambda item: item[1]))


Shapes = tuple[tuple[int, int, int], ...]


class Gates(NamedTuple):
    """The gates of T tasks.

    ``shapes`` holds (J, K, G) for each level: the level has G gates with K operands each, and an operand is the
    conjunction of J values or the negation of such a conjunction.
    """

    inputs: Tensor  # (T, sum of J*K*G) int64, indices into the values and the gates of lower levels
    negated: Tensor  # (T, sum of K*G) bool, true for negated operands
    shapes: Shapes


Operand = tuple[Sequence[int], bool]


def compile_gates(
    tasks: Sequence[Sequence[Expression]], leaves: Sequence[Callable[[Expression], Operand]], size: int, true: int
) -> Gates:
    """Compile the expressions of T tasks.

    Args:
        tasks: the expressions of each task. Shorter lists are padded with expressions that are never true.
        leaves: for each task, a function from a leaf or its negation to (indices of its values, negated).
        size: the number of values of a task, including the value that is always true.
        true: the index of the value that is always true.
    """
    inner = [inner_gates(expressions) for expressions in tasks]
    places: list[dict[Expression, int]] = [{} for _ in tasks]  # the index of each gate's value

    def operands(task: int, parts: Iterable[Expression]) -> list[Operand]:
        return [leaves[task](part) if part.kind == "leaf" else ([places[task][negate(part)]], True) for part in parts]

    tables = []
    for level in range(1 + max((max(own.values(), default=-1) for own in inner), default=-1)):
        gates = [[gate for gate in own if own[gate] == level] for own in inner]
        rows = [[operands(task, gate.parts) for gate in own] for task, own in enumerate(gates)]
        tables.append(_tables(rows, true))
        for place, own in zip(places, gates, strict=True):
            place.update((gate, size + number) for number, gate in enumerate(own))
        size += max(map(len, gates))
    rows = [
        [[([true], True)] if each == FALSE else operands(task, each.parts if each.kind == "all" else [each])
         for each in expressions]
        for task, expressions in enumerate(tasks)
    ]  # fmt: skip
    tables.append(_tables(rows, true))
    inputs, negated, shapes = zip(*tables, strict=True)
    return Gates(torch.cat(inputs, 1), torch.cat(negated, 1), shapes)


def _tables(rows: list[list[list[Operand]]], true: int) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """Return the inputs, the negated operands and the shape (J, K, G) of a level.

    ``rows`` holds, for each task and each gate, the gate's operands.
    """
    count = max(map(len, rows))
    width = max([1, *(len(gate) for own in rows for gate in own)])
    depth = max([1, *(len(values) for own in rows for gate in own for values, _ in gate)])
    never: list[Operand] = [([true], True)]
    full = [
        [[*gate, *[([true], False)] * (width - len(gate))] for gate in own + [never] * (count - len(own))]
        for own in rows
    ]
    inputs = [[[[*values, *[true] * (depth - len(values))] for values, _ in gate] for gate in own] for own in full]
    negated = torch.tensor([[[flipped for _, flipped in gate] for gate in own] for own in full])
    return (
        torch.tensor(inputs).permute(0, 3, 2, 1).flatten(1),
        negated.transpose(1, 2).flatten(1),
        (depth, width, count),
    )


def evaluate_gates(values: Tensor, gates: Gates, truth: Truth) -> Tensor:
    """Return the truth or the logits (B, S) of expressions.

    Args:
        values: (B, A), bool for "exact", otherwise logits.
        gates: the gates of each row, with ``inputs`` and ``negated`` of length B.
        truth: how gates combine values; gradients flow through both kinds of logits.
    """
    inputs = negated = 0
    for number, (depth, width, count) in enumerate(gates.shapes):
        chosen = gates.inputs[:, inputs : (inputs := inputs + depth * width * count)]
        flips = gates.negated[:, negated : (negated := negated + width * count)].unflatten(1, (width, count))
        # A logical AND of a few tensors is far faster than all() over a short axis.
        parts = values.gather(1, chosen).unflatten(1, (depth, width, count)).unbind(1)
        if truth == "exact":
            result = reduce(torch.logical_and, (reduce(torch.logical_and, parts) ^ flips).unbind(1))
        else:
            operands = reduce(torch.minimum, parts)
            operands = torch.where(flips, -operands, operands)
            result = operands.amin(1) if truth == "min-max" else product(operands.transpose(1, 2).contiguous())
        if number + 1 < len(gates.shapes):
            values = torch.cat((values, result), 1)
    return result


def product(logits: Tensor) -> Tensor:
    """Return the logit (...) of the conjunction of independent statements with logits (..., K).

    The probability is the product of the probabilities sigmoid(l), so its logit is
    -log(expm1(sum(softplus(-l)))). The result is at most 30.
    """
    doubt = nn.functional.softplus(-logits).sum(-1).clamp(min=1e-13)
    return -(doubt + torch.log(-torch.expm1(-doubt)))
