"""Boolean expressions: normal form, sharing, truth, and the outline of guards."""

from __future__ import annotations

import gc
import pickle
from copy import deepcopy
from itertools import product

import pytest
from conditions import build
from hypothesis import given, settings
from hypothesis import strategies as st
from speed import within

from lw_torchrl.language import expressions
from lw_torchrl.language.expressions import (
    FALSE,
    TRUE,
    Expression,
    all_of,
    any_of,
    as_expression,
    count_mentions,
    evaluate,
    fold,
    implied,
    leaves,
    negate,
    replace_leaves,
)
from lw_torchrl.language.outline import outline

LEAVES = "abcd"
# Trees of ("all" | "any" | "not", parts) that are interpreted directly.
TREES = st.recursive(
    st.sampled_from([*LEAVES, ("all", []), ("any", [])]),
    lambda inner: (
        st.tuples(st.sampled_from(["all", "any"]), st.lists(inner, max_size=4)) | st.tuples(st.just("not"), inner)
    ),
    max_leaves=20,
)


def interpret(tree, truth: dict[str, bool]) -> bool:
    if isinstance(tree, str):
        return truth[tree]
    operator, parts = tree
    if operator == "not":
        return not interpret(parts, truth)
    return (all if operator == "all" else any)([interpret(part, truth) for part in parts])


STATES = [dict(zip(LEAVES, values, strict=True)) for values in product((False, True), repeat=len(LEAVES))]


@given(TREES)
def test_truth_equals_that_of_the_tree(tree) -> None:
    expression = all_of([build(tree)])
    for truth in STATES:
        value = interpret(tree, truth)
        assert evaluate(expression, truth) == value
        assert evaluate(negate(expression), truth) != value
        assert not value or all(evaluate(literal, truth) for literal in implied(expression))


@given(TREES)
def test_normal_form(tree) -> None:
    expression = all_of([build(tree)])

    def check(each: Expression, parts: list) -> None:
        if each.kind == "leaf":
            return
        own = each.parts
        assert len(own) != 1
        assert len({*own}) == len(own)
        assert not any(negate(part) in own or part.kind == each.kind for part in own)
        assert all(part.parts or part.kind == "leaf" for part in own)

    fold(expression, check)
    assert negate(negate(expression)) == expression
    assert all_of([expression, expression]) == any_of([expression, expression]) == expression
    assert (all_of([expression, negate(expression)]), any_of([expression, negate(expression)])) == (FALSE, TRUE)
    assert replace_leaves(expression, lambda leaf: leaf) == expression
    again = replace_leaves(expression, lambda leaf: negate(leaf + leaf))
    assert replace_leaves(again, lambda leaf: negate(leaf[0])) == expression
    for copy in (deepcopy(expression), pickle.loads(pickle.dumps(expression))):
        assert (copy, hash(copy)) == (expression, hash(expression))
        assert copy.node is expression.node


def test_text() -> None:
    expression = all_of([any_of(["a", negate("b")]), any_of(["c", all_of(["a", "d"])])])
    assert str(expression) == "(a or not b) and (c or a and d)"
    assert leaves(expression) == ("a", "b", "c", "d")
    assert count_mentions(expression) == 5
    assert (str(TRUE), str(FALSE)) == ("always", "never")


def test_what_follows_is_simplified() -> None:
    both = all_of(["a", "b"])
    assert all_of(["a", any_of(["a", "b"]), "c"]) == all_of(["a", "c"])
    assert all_of(["b", negate(both), "a"]) == FALSE
    assert any_of([both, "c", both, any_of(["d"])]) == any_of([both, "c", "d"])


def tower(levels: int) -> Expression:
    """Return alternations whose text is of length 64 ** levels."""
    tip = all_of(["tip"])
    for level in range(levels):
        tip = all_of([any_of([tip, f"{level} {number}"]) for number in range(64)])
    return tip


def test_shared_parts_take_linear_time() -> None:
    with within(1):
        doubled = all_of(["x"])
        for _ in range(1_000):
            doubled = all_of([doubled, doubled])
        assert doubled == all_of(["x"])
        high = tower(30)
        assert high == tower(30)
        assert high != negate(high)
        assert count_mentions(high) > 64**30
        assert pickle.loads(pickle.dumps(deepcopy(high))) == high
        assert evaluate(high, dict.fromkeys(leaves(high), True))
        assert not evaluate(negate(high), dict.fromkeys(leaves(high), True))
        assert replace_leaves(high, lambda leaf: leaf) == high
        assert implied(negate(high)) == (negate("tip"),)
        assert repr(high) == "<all of 64 expressions>"


def test_depth_is_not_limited_and_unused_nodes_are_freed() -> None:
    gc.collect()
    before = len(expressions._nodes)
    deep = all_of(["x"])
    for level in range(20_000):
        deep = any_of([all_of([deep, f"and {level}"]), f"or {level}"])
    assert len(leaves(deep)) == 40_001
    assert pickle.loads(pickle.dumps(deep)) == deep
    assert str(deep).count("(") == 19_999
    del deep
    assert len(expressions._nodes) <= before


def test_wide_expressions_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 1000 parts"):
        any_of(map(str, range(1_001)))


guards = st.recursive(
    st.sampled_from([*map(as_expression, LEAVES), *map(negate, LEAVES), TRUE, FALSE]),
    lambda inner: st.builds(lambda join, parts: join(parts), st.sampled_from((all_of, any_of)), st.lists(inner)),
    max_leaves=6,
)


@settings(max_examples=300)
@given(st.lists(guards, max_size=6))
def test_an_outline_means_the_guards(guards) -> None:
    """The conditions above a step, with those that "else" excludes, are the step's guard."""
    lines = outline(guards)
    assert [line.steps[0] for line in lines if not line.head] == list(range(len(guards)))
    for truth in STATES:
        path, chain = [], {}  # whether the open branches hold, and for each depth, no branch above did
        for line in lines:
            del path[line.depth :]
            chain = {depth: none for depth, none in chain.items() if depth <= line.depth}
            if not line.head:
                assert all(path) == evaluate(guards[line.steps[0]], truth)
                continue
            before = line.head == "if" or chain[line.depth]
            holds = line.condition is None or evaluate(line.condition, truth)
            path.append(before and holds)
            chain[line.depth] = before and not holds
