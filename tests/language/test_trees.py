"""JSON and YAML of any shape: the structure and the texts determine the plan, not the names of the keys."""

import json

import pytest
from cases import read_cases
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_texts import read_table
from speed import within

import lw_torchrl as lw
from lw_torchrl.language.expressions import evaluate, leaves
from lw_torchrl.language.formats.trees import TreeReading
from lw_torchrl.language.formats.values import parse_value
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.programs import compile_program

SHAPES = read_table("tree_shapes.toml") | read_table("program_shapes.toml")


def active_verbs(plan, near, is_open):
    """Return the first words of the active steps; all conditions but two are false."""
    verbs = []
    for step in plan.steps:
        truth = {
            clause: near if clause.predicate == "near" and clause.subject == GRIPPER else is_open
            for clause in leaves(step.condition.expression)
            if clause.predicate in ("near", "open") and clause.subject == GRIPPER
        }
        truth = {clause: truth.get(clause, False) for clause in leaves(step.condition.expression)}
        if evaluate(step.condition.expression, truth):
            verbs.append(step.skill.split()[0].lower())
    return verbs


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_of_a_policy_is_the_same_plan(name):
    plan = lw.decode_plan(SHAPES[name], "push").plan
    assert plan is not None
    assert len(plan.steps) == 3
    found = [active_verbs(plan, near, is_open) for near in (True, False) for is_open in (True, False)]
    assert found == [["close"], ["push"], ["move"], ["move"]]


FACTS = {"a": "gripper near puck", "b": "gripper open", "c": "puck above wall", "d": "puck near target location"}
policies = st.recursive(
    st.integers(0, 99), lambda inner: st.tuples(st.sampled_from("abcd"), st.booleans(), inner, inner), max_leaves=6
)
KEYS = [("if", "then", "else"), ("query", "on_true", "on_false"), ("situation", "response", "otherwise"),
        ("when", "run", "default"), ("Is it so", "yes", "no")]  # fmt: skip


def spell(draw, policy):
    """Return a policy as a JSON value in one of many spellings."""
    if isinstance(policy, int):
        text = f"move to {policy}"
        return draw(st.sampled_from([{"do": text}, {"type": "action", "text": text}, {"Action": text}, {"unit": text}]))
    fact, negated, then, otherwise = policy
    test = FACTS[fact]
    if negated:
        test = draw(st.sampled_from([{"not": test}, f"not ({test})", {"type": "inverter", "child": {"check": test}}]))
    then, otherwise = spell(draw, then), spell(draw, otherwise)
    style = draw(st.sampled_from(["keys", "tree", "arrows", "rules", "pairs"]))
    if style == "keys":
        return dict(zip(draw(st.sampled_from(KEYS)), (test, then, otherwise), strict=True))
    if style == "tree":
        check = {"type": "condition", "query": test}
        first = {"type": "sequence", "name": "first", "children": [check, then]}
        return {"type": "selector", "name": "root", "children": [first, otherwise]}
    if style == "arrows":
        return {"?": [{"->": [{"check": test}, then]}, otherwise]}
    if style == "rules":
        return {"rules": [{"when": test, "do": then}], "otherwise": otherwise}
    return {"policy": [[{"check": test}, then], ["otherwise", otherwise]]}


def carried_out(policy, truth):
    while not isinstance(policy, int):
        policy = policy[2] if truth[policy[0]] != policy[1] else policy[3]
    return policy


@settings(max_examples=150)
@given(st.data(), policies)
def test_a_spelled_policy_activates_the_actions_that_it_carries_out(data, policy):
    text = json.dumps(spell(data.draw, policy))
    steps = compile_program(TreeReading(text).section.tree)
    for number in range(16):
        truth = {fact: bool(number >> place & 1) for place, fact in enumerate("abcd")}
        texts = {FACTS[fact]: value for fact, value in truth.items()} | {
            f"not ({FACTS[fact]})": not value for fact, value in truth.items()
        }
        active = {int(step.action.text.split()[-1]) for step in steps if evaluate(step.guard, texts)}
        assert active == {carried_out(policy, truth)}, text


WORDS = (
    "if", "then", "else", "elif", "not", "until", "to", "from", "states", "transitions", "next", "start", "type",
    "selector", "id", "1", "?", "->", "near", "open", "gripper", "push", "gripper near puck", "close the gripper",
)  # fmt: skip
words = st.sampled_from(WORDS)
values = st.recursive(
    st.none() | st.booleans() | st.integers(0, 3) | words,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(words, inner, max_size=4),
    max_leaves=15,
)


@settings(max_examples=300)
@given(values)
def test_no_value_raises_an_error(value):
    lw.decode_plan(json.dumps(value), "push")


@pytest.mark.parametrize(("condition", "query"), read_cases("language/values.toml")["conditions"])
def test_conditions_in_parts_and_their_negations(condition, query):
    rules = {"rules": [{"when": condition, "do": "lift the puck"}, {"do": "wait"}]}
    assert str(lw.decode_plan(json.dumps(rules), "push").plan.steps[0].condition) == query


@pytest.mark.parametrize("key", ["achieved_if", "done_when", "goal_test", "satisfied", "skip_if", "effect"])
def test_the_steps_of_a_subgoal_run_until_it_is_achieved(key):
    steps = [
        {"if": "gripper near puck", "do": "close the gripper"},
        {"else": True, "do": "move the gripper to the puck"},
    ]
    subgoals = [
        {"name": "hold it", key: ["gripper near puck", "gripper closed"], "how": steps},
        {"name": "push it", key: "puck near target location", "how": [{"do": "push the puck to the target location"}]},
    ]
    plan = lw.decode_plan(json.dumps({"subgoals": subgoals}), "push").plan
    assert [str(step.condition).replace("the robot's gripper is ", "") for step in plan.steps] == [
        "not closed and near the puck",
        "not near the puck",
        "near the puck and closed and the puck is not near the target location",
    ]


DRAFT = {"when": "gripper near puck", "do": "lift the puck"}
RULE = {"when": "gripper near puck", "do": "grasp the puck"}


@pytest.mark.parametrize("key", ["reasoning", "notes", "example_2", "old_rules", "chain_of_thought", "rejected"])
@pytest.mark.parametrize("value", [DRAFT, [DRAFT], "When the gripper is near the puck, lift the puck."])
def test_what_is_not_a_part_of_the_plan_is_left_out_with_a_note(key, value):
    for row in ({key: value, "rules": [RULE]}, {"rules": [{**RULE, key: value}]}):
        decoded = lw.decode_plan(json.dumps(row), "push")
        assert [step.skill for step in decoded.plan.steps] == ["grasp the puck"]
        assert any("lift the puck" in note.text and key in note.text for note in decoded.notes)


HOSTILE = {
    "lists": "[" * 20_000,
    "closed lists": "[" * 20_000 + "]" * 20_000,
    "objects": '{"rules": ' * 20_000,
    "yaml": "\n".join(f"{'  ' * depth}a{depth}:" for depth in range(300)),
    "references": "a0: &a0 [close the gripper]\n"
    + "\n".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)),
    "names": json.dumps({f"n{number}": [f"n{number + 1}"] * 3 for number in range(3_000)}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_values_are_read_within_seconds(name):
    with within(5):  # 0.5 s on a quiet machine; following every reference would never end
        reading = TreeReading(HOSTILE[name])
        assert reading.error or name in ("yaml", "names")


def test_values_as_models_write_them():
    assert parse_value('Sure:\n{"a": [1, 2,], // two\n "b": {"c": "d"') == {"a": [1, 2], "b": {"c": "d"}}
    assert parse_value('{"a": 1}\n{"b": 2}') == [{"a": 1}, {"b": 2}]
    assert parse_value("{a: 'b', c: [d]}") == {"a": "b", "c": ["d"]}
    assert parse_value("Here it is.\n\nrules:\n  - if: !open(gripper)\n    then: wait\n\nDone.") == {
        "rules": [{"if": "!open(gripper)", "then": "wait"}]
    }
    assert parse_value("rules:\n  # - {if: a, do: b}\n  - {if: c, do: d}\n") == {"rules": [{"if": "c", "do": "d"}]}
    assert parse_value("close the gripper") is None
