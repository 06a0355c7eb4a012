"""Outlines: the conditions above a step, with those that "else" excludes, are the step's guard."""

from itertools import product

from hypothesis import given, settings
from hypothesis import strategies as st

from lw_torchrl.language.expressions import FALSE, TRUE, all_of, any_of, as_expression, evaluate, negate
from lw_torchrl.language.outline import outline

LEAVES = "abc"
STATES = [dict(zip(LEAVES, truth, strict=True)) for truth in product((False, True), repeat=len(LEAVES))]
expressions = st.recursive(
    st.sampled_from([*map(as_expression, LEAVES), *map(negate, LEAVES), TRUE, FALSE]),
    lambda inner: st.builds(lambda join, parts: join(parts), st.sampled_from((all_of, any_of)), st.lists(inner)),
    max_leaves=6,
)


@settings(max_examples=300)
@given(st.lists(expressions, max_size=6))
def test_an_outline_means_the_guards(guards):
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
