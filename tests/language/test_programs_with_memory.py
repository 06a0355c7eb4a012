"""Sequences with memory and the perfect tense become latches; a direct interpreter of the trees agrees."""

from __future__ import annotations

import json
from typing import Any

from conditions import visit_with_memory
from hypothesis import given
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.expressions import Expression, Once, as_expression, evaluate, fold, negate
from lw_torchrl.language.plan_files import parse_plan
from lw_torchrl.language.programs import Action, Branch, Check, Node, Sequence, compile_program

FACTS = ("a", "b", "c", "d")
literals = st.builds(
    lambda name, negated: negate(name) if negated else as_expression(name), st.sampled_from(FACTS), st.booleans()
)
actions = st.sampled_from(FACTS).map(lambda name: Action(f"do {name}"))  # the effect of "do a" is a


def sequences(parts: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
    return st.builds(
        lambda listed, memory: Sequence(tuple(listed), memory), st.lists(parts, min_size=1, max_size=3), st.booleans()
    )


def branches(parts: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
    return st.builds(Branch, literals, parts, st.none() | parts)


trees = st.recursive(
    actions | st.builds(Check, literals), lambda parts: sequences(parts) | branches(parts), max_leaves=8
).map(lambda node: Sequence((node, Action("do a")), memory=True))


class Ticker:
    """A behaviour tree that is ticked at each control step; a sequence with memory stores its next part."""

    def __init__(self) -> None:
        self.next: dict[tuple[int, ...], int] = {}

    def tick(self, node: Node, truth: dict[str, bool], path: tuple[int, ...] = ()) -> tuple[str, list[str]]:
        """Return the status and the active actions."""
        if isinstance(node, Action):
            return "success" if truth[node.text[-1]] else "running", [node.text]
        if isinstance(node, Check):
            return "success" if evaluate(node.condition, truth) else "failure", []
        if isinstance(node, Branch):
            if evaluate(node.condition, truth):
                return self.tick(node.then, truth, (*path, 0))
            return ("success", []) if node.otherwise is None else self.tick(node.otherwise, truth, (*path, 1))
        assert isinstance(node, Sequence)
        active: list[str] = []
        for number in range(self.next.get(path, 0) if node.memory else 0, len(node.parts)):
            status, active = self.tick(node.parts[number], truth, (*path, number))
            if status != "success":
                return status, active
            if node.memory:
                self.next[path] = number + 1
                active = []
        return "success", active


def active_steps(guards: list[Expression], truth: dict[str, bool], latched: set[Once]) -> list[bool]:
    return [fold(guard, visit_with_memory(truth, latched)) for guard in guards]


@given(trees, st.lists(st.fixed_dictionaries({name: st.booleans() for name in FACTS}), max_size=8))
def test_compiled_trees_with_memory_act_like_ticked_trees(tree: Node, states: list[dict[str, bool]]):
    steps = compile_program(tree, lambda text: text[-1])
    ticker, latched = Ticker(), set[Once]()
    for truth in states:
        _, expected = ticker.tick(tree, truth)
        truths = active_steps([step.guard for step in steps], truth, latched)
        active = [step.action.text for step, is_active in zip(steps, truths, strict=True) if is_active]
        assert active == expected


TREE: dict[str, Any] = {
    "children": [
        {"type": "condition", "name": "the gripper is open"},
        {"type": "action", "name": "move the gripper above the puck"},
        {"type": "action", "name": "close the gripper"},
    ]
}


def test_spellings_of_a_sequence_with_memory():
    kinds = [{"type": kind} for kind in ("SequenceStar", "sequence_with_memory", "Sequence*")]
    texts = [json.dumps({**kind, **TREE}) for kind in [*kinds, {"type": "sequence", "memory": True}]]
    texts.append(json.dumps({"sequence_with_memory": TREE["children"]}))
    plans = [lw.decode_plan(text, "push").plan for text in texts]
    for plan in plans:
        assert plan is not None
        opened = "the robot's gripper has been open"
        above = f"once ({opened} and the robot's gripper is above the puck)"
        closed = f"once ({above} and the robot's gripper is closed)"
        conditions = [str(step.condition) for step in plan.steps]
        assert conditions == [f"{opened} and not {above}", f"{above} and not {closed}"]
        assert parse_plan(str(plan), "push") == plan
    without = lw.decode_plan(json.dumps({"type": "sequence", **TREE}), "push").plan
    assert without is not None
    assert not any(step.condition.has_latch for step in without.steps)
